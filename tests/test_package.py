"""The package as installed: public names, version, data, and how fast it is there."""

import subprocess
import sys
import time
import tomllib
from importlib import metadata, resources
from pathlib import Path

import pytest

import sehdr_warp

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("name", sehdr_warp.__all__)
def test_public_names_load_and_are_documented(name):
    assert getattr(sehdr_warp, name).__doc__
    assert name in dir(sehdr_warp)


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        sehdr_warp.trian  # noqa: B018


def test_versions_agree():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert sehdr_warp.__version__ == stated == metadata.version("sehdr-warp")


def test_kernels_and_presets_are_inside_the_package():
    assert (resources.files("sehdr_warp.configs") / "default.toml").is_file()
    code = "import sehdr_warp.kernels, importlib.util as u; print(u.find_spec('kernels'))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd="/").stdout
    assert found.strip() == "None", "kernels must not be importable under its own name"


def test_every_subpackage_is_listed_for_installation():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for path in (ROOT / "sehdr_warp").rglob("__init__.py")}
    names = {".".join(path.relative_to(ROOT).parts) for path in folders} | {"sehdr_warp.kernels", "sehdr_warp.configs"}
    assert names == set(setup["packages"])


def test_import_is_quick():
    best = min(_seconds("import sehdr_warp") for _ in range(3))
    assert best < 1.0


def _seconds(code):
    started = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - started
