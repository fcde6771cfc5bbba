"""Pictures from the command line against stored ones: a file of Gaussians, and a short training.

After an intended change, write the stored pictures anew: python -m tests.integration.test_golden
"""

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from sehdr_warp import cli
from sehdr_warp.scene.images.hdr_files import read_hdr

DATA = Path(__file__).resolve().parents[1] / "data" / "golden"
RENDERED = ("render", DATA / "splats.ply", "--cameras", DATA / "cameras.json")
TRAINED = (
    "train", "embedded", "--preset", "demo", "--response", "hdr-nerf", "--seed", 3,
    "--iterations", 60, "--max-size", 40,
)  # fmt: skip
LEAST_DB = 25.0
"""Mu-law PSNR of the short training against its stored picture. Another seed has 28.8 dB, so tuning of the training
passes; a wrong scale, response or camera does not."""


def run(*words) -> None:
    """Run a command line in this process; it must succeed."""
    with pytest.raises(SystemExit) as end:
        cli.main([str(word) for word in (*words, "--device", "cpu", "-q")])
    assert end.value.code == 0


def rendered(folder: Path) -> np.ndarray:
    """Return the picture of the stored Gaussians, rendered into a folder."""
    run(*RENDERED, "--out", folder)
    (picture,) = sorted((folder / "hdr").glob("*.exr"))
    return read_hdr(picture)


def trained(folder: Path) -> np.ndarray:
    """Return the first held-out view of a short training into a folder."""
    run(*TRAINED, "--out", folder / "run")
    run("render", folder / "run", "--out", folder / "views")
    return read_hdr(min((folder / "views" / "hdr").glob("*.exr")))


def test_a_file_of_gaussians_renders_as_stored(tmp_path):
    picture, stored = rendered(tmp_path), np.load(DATA / "rendered.npy")
    np.testing.assert_allclose(picture, stored, rtol=2e-3, atol=1e-4 * stored.max())


def test_a_short_training_gives_the_stored_picture(tmp_path):
    picture, stored = trained(tmp_path), np.load(DATA / "trained.npy").astype(np.float32)
    scaled = [np.log1p(5000 * np.clip(image / stored.max(), 0, 1)) / np.log(5001) for image in (picture, stored)]
    decibels = -10 * np.log10(np.mean((scaled[0] - scaled[1]) ** 2) + 1e-12)
    assert decibels > LEAST_DB, f"{decibels:.1f} dB: a change of the training? See the head of this file"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        np.save(DATA / "rendered.npy", rendered(Path(temporary) / "a"))
        np.save(DATA / "trained.npy", trained(Path(temporary) / "b").astype(np.float16))
    shutil.rmtree(DATA / "__pycache__", ignore_errors=True)
    sys.exit(0)
