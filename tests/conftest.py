"""Fixtures of all tests: devices, and the optional folder of larger real data."""

import logging
import os
from pathlib import Path

import pytest

from sehdr_warp.process import calm_threads, collect_late

collect_late()
calm_threads()  # Before anything loads torch.
# Tests run side by side: threads of linear algebra would wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent


def available_devices() -> list[str]:
    """The torch devices the tests run on: always the CPU, and the first GPU where there is one."""
    import torch

    return ["cpu", "cuda:0"] if torch.cuda.is_available() else ["cpu"]


def pytest_ignore_collect(collection_path, config):
    """Leave out tests/trial, a third of all tests, unless -m or a path asks for it."""
    folder = ROOT / "tests" / "trial"
    with_trials = config.option.markexpr != "not trial" or any("trial" in argument for argument in config.args)
    return True if collection_path == folder and not with_trials else None


def pytest_generate_tests(metafunc):
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", available_devices())


@pytest.fixture(autouse=True)
def plain_logs():
    """Undoes what a command line that a test ran in this process set up, so that caplog sees the package's logs."""
    logger = logging.getLogger("sehdr_warp")
    logger.propagate, logger.handlers = True, []
    logger.setLevel(logging.NOTSET)


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory):
    """Structure from motion keeps its results for the session, not in the user's cache."""
    os.environ["SEHDR_CACHE"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True, scope="session")
def no_flushes():
    """Skip flushes: files of tests need not outlive a power cut, and some ten thousand flushes take their time."""
    real, os.fsync = os.fsync, lambda handle: None
    yield
    os.fsync = real


@pytest.fixture(scope="session")
def embedded_run(own_cache, tmp_path_factory) -> Path:
    """A very short training of the embedded scene, made through the command line; not to be changed."""
    from .refusals import call

    out = tmp_path_factory.mktemp("embedded") / "run"
    flags = "--preset demo --iterations 30 --max-size 48 --response hdr-nerf --device cpu --seed 3"
    assert call("train", "embedded", "--out", out, *flags.split()) == 0
    return out


@pytest.fixture
def few_probes(monkeypatch):
    """Photos of some 64 pixels tell by fewer of them how far away things are."""
    monkeypatch.setattr("sehdr_warp.training.matching.PROBES", 300)


@pytest.fixture
def coarse_figures(monkeypatch):
    """Figures of fewer pixels: drawing them is most of a report's time."""
    from matplotlib.figure import Figure

    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *args, **options: save(figure, *args, **options | {"dpi": 50})
    )


@pytest.fixture(scope="session")
def shared() -> Path:
    """Larger real data (photos, rendered rooms, response curves), which the repository does not carry."""
    folder = Path(os.environ.get("SEHDR_SHARED", ROOT.parent / "shared"))
    if not folder.is_dir():
        pytest.skip("larger real data is not here (set SEHDR_SHARED)")
    return folder


@pytest.fixture(scope="session")
def castle_photos(shared, tmp_path_factory) -> Path:
    """Eleven photos at a sixth of their size, whose cameras the session's cache keeps; not to be changed."""
    from PIL import Image

    folder = tmp_path_factory.mktemp("castle") / "photos"
    folder.mkdir()
    for photo in (shared / "data" / "castle").glob("*.JPG"):
        with Image.open(photo) as image:
            image.reduce(6).save(folder / photo.name, exif=image.getexif(), quality=95)
    return folder


@pytest.fixture
def logged():
    """Return the lines that the package logs during a test, also after the command line has set logging up."""
    lines, logger = [], logging.getLogger("sehdr_warp")
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel("INFO")
    yield lines
    logger.removeHandler(handler)
    logger.setLevel(level)
