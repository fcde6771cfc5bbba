"""Photos with gain maps as the benchmark writes them, and photos two stops darker, as a training reads them."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import phone
from sehdr_warp.scene import load_scene


@pytest.fixture(scope="module")
def truth():
    """Three views of the scene."""
    scene = load_scene("embedded:metal", response="srgb")
    return replace(scene, views=(*scene.train_views[:2], *scene.test_views[:1]))


@pytest.mark.parametrize("photos", phone.KINDS)
def test_sets_hold_the_light_of_the_truth(truth, tmp_path, monkeypatch, photos):
    if photos == "libultrahdr":
        pytest.importorskip("imagecodecs")
    monkeypatch.setattr(phone, "load_scene", lambda *_, **__: truth)
    phone.write_set(tmp_path / "set", "metal", photos)
    darker = bool(phone.KINDS[photos].stops)
    scene = load_scene(tmp_path / "set", max_size=100, response="srgb" if darker else "auto")
    assert scene.response.name == ("srgb" if darker else "gain-map"), "load_scene chose another response"
    view = scene.train_views[0]
    light = scene.response.decode(view.codes / np.iinfo(view.codes.dtype).max) / view.exposure_time
    below_white = (view.hdr > 0.05) & (view.hdr < 0.8 * 4**darker)
    assert np.median(light[below_white] / view.hdr[below_white]) == pytest.approx(1, abs=0.02)
    # Light above white: a gain map of three channels tells all, one of one channel the brightest channel's.
    above = view.hdr.min(2) > 1.2
    if not darker and above.any():
        assert np.median(light[above] / view.hdr[above]) == pytest.approx(1, abs=0.1)
