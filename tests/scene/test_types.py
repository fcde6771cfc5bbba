"""Scenes and views."""

from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.scene import load_scene
from sehdr_warp.scene.types import codes_of


def test_scenes_views_and_cameras_print_in_one_line():
    scene = load_scene("embedded", max_size=32)
    view = scene.views[0]
    assert repr(scene) == "Scene('embedded', hdr-nerf, 27 views of 32 x 32, 18 to train)"
    assert repr(view) == "View('train_r_0', 32 x 32, train, 0.5 s)"
    assert repr(view.camera).startswith("Camera(32 x 32, focal length 32.8") and "\n" not in repr(view.camera)


def test_values_that_8_bits_hold_become_8_bits_and_others_16():
    values = np.arange(256) / 255
    np.testing.assert_array_equal(codes_of(values), np.arange(256, dtype=np.uint8))
    for codes in (codes_of(values + 0.001), codes_of(values, 16)):
        assert codes.dtype == np.uint16
    np.testing.assert_array_equal(codes_of([-1.0, 0.77, 9.0]), np.array([0, 50462, 65535], np.uint16))
    np.testing.assert_array_equal(codes_of([0.77], 8), np.array([196], np.uint8))


@pytest.mark.parametrize("codes", [np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8)])
def test_codes_of_another_kind_or_shape_are_refused(codes):
    with pytest.raises(ValueError, match=r"not uint8 or uint16 \[H, W, 3\]; see codes_of"):
        replace(load_scene("embedded", max_size=32).views[0], codes=codes)
