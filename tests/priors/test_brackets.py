"""Exposure stacks of a known scene: the truth that darker photos show, and figures of the estimates beside it."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from priors.brackets import main, merge, read_exposures
from sehdr_warp.response import response_by_name

TIMES = [2.0**stop for stop in range(-8, 1, 2)]


@pytest.fixture
def stacks(tmp_path):
    """A folder with a stack of a room with a window and a lamp, six and four stops over white, and a useless one."""
    rng, curve = np.random.default_rng(0), response_by_name("camera")
    light = np.exp(gaussian_filter(rng.normal(size=(96, 128, 3)), (4, 4, 0)) * 8) * 0.1
    light[10:40, 10:30], light[60:66, 90:96] = 2.0**4, 2.0**6
    folder = tmp_path / "stacks" / "room"
    folder.mkdir(parents=True)
    for time in TIMES:
        codes = np.rint(255 * np.asarray(curve.encode(light * time * curve.white))).astype(np.uint8)
        Image.fromarray(codes).save(folder / f"{time}.png")
    (folder / "exposures.json").write_text(json.dumps({f"{time}.png": time for time in TIMES}))
    (tmp_path / "stacks" / "empty").mkdir()
    return tmp_path / "stacks", light


def test_the_truth_is_what_darker_photos_show(stacks):
    folder, light = stacks
    radiance = merge(read_exposures(folder / "room"))
    # Up to a factor: the stack tells the curve up to its white.
    ratio = radiance[light.min(2) > 2**-6] / light[light.min(2) > 2**-6]
    assert np.isfinite(radiance).all() and ratio.std() < 0.05 * ratio.mean()


def test_figures_are_written_and_useless_stacks_named(stacks, tmp_path, caplog):
    with caplog.at_level("INFO"):
        main(stacks[0], out=tmp_path / "brackets.json")
    assert "empty: is not a folder of photos" in caplog.text
    figures = json.loads((tmp_path / "brackets.json").read_text())
    brightest = figures["photos"][-1]
    assert brightest["stack"] == "room" and brightest["share"] == pytest.approx((600 + 36) / (96 * 128), abs=0.01)
    # The mean square of four stops of the window and six of the lamp
    assert brightest["white_rms"] == pytest.approx(np.sqrt((600 * 16 + 36 * 36) / 636), rel=0.1)
    assert sum(row["photos"] for row in figures["rows"]) == len(figures["photos"])
