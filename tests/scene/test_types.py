"""Scenes and views."""

from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.scene import Camera, Scene, View, load_scene
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
    with pytest.raises(ValueError, match=r"not NumPy's uint8 or uint16 \[H, W, 3\]; see codes_of"):
        replace(load_scene("embedded", max_size=32).views[0], codes=codes)


CAMERA = Camera(4, 3, 5.0, 5.0, 2.0, 1.5, np.eye(4))
CODES = np.full((3, 4, 3), 9, np.uint8)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"name": 7}, "^name of a view is 7, expected text$"),
        ({"camera": np.eye(4)}, r"^camera of view a is float64 \[4, 4\], expected a Camera$"),
        (
            {"camera": CAMERA.resized(8, 6)},
            "^camera of view a is of 8 x 6 pixels, its codes 4 x 3; see Camera.resized$",
        ),
        ({"exposure_time": 0.0}, "^exposure_time of view a is 0.0, expected seconds above 0"),
        ({"exposure_time": np.nan}, "^exposure_time of view a is nan, expected seconds above 0"),
        ({"exposure_time": "1/125"}, "^exposure_time of view a is '1/125', expected a number of seconds$"),
        ({"split": "val"}, "^split of view a is 'val', expected 'train' or 'test'$"),
        ({"mask": np.ones((4, 3), np.float32)}, r"^mask of view a is float32 \[4, 3\], expected .* float32 \[3, 4\]"),
        (
            {"mask": np.full((3, 4), 255, np.uint8)},
            r"^mask of view a is uint8 \[3, 4\], expected a NumPy array float32",
        ),
        ({"mask": [[1.0] * 4] * 3}, "^mask of view a is a list of 3, expected a NumPy array float32"),
        ({"hdr": CODES / 255}, r"^hdr of view a is float64 \[3, 4, 3\], expected a NumPy array float32 \[3, 4, 3\]"),
        ({"light_above_white": CODES[:1] / np.float16(1)}, "^light_above_white of view a is .*, expected .* float16"),
        ({"source": "a.png"}, "^source of view a is 'a.png', expected a pathlib.Path$"),
        ({"orientation": 0}, "^orientation of view a is 0, expected EXIF's, 1 to 8$"),
    ],
)
def test_fields_of_a_view_that_cannot_be_are_named(changes, words):
    fields = {"name": "a", "codes": CODES, "camera": CAMERA, "exposure_time": 1.0, "split": "train"}
    assert View(**fields, mask=np.ones((3, 4), np.float32)).codes is CODES, "photos are not copied"
    with pytest.raises((TypeError, ValueError), match=words):
        View(**fields | changes)


VIEWS = tuple(View(name, CODES, CAMERA, 1.0, "train") for name in "ab")
POINTS, COLORS = np.zeros((5, 3)), np.full((5, 3), 0.5, np.float32)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"views": VIEWS[0]}, r"^views of scene s is View\('a', .*, expected a tuple of Views$"),
        ({"views": [VIEWS[0], "b"]}, "^views of scene s has 'b', expected Views$"),
        ({"views": [*VIEWS, VIEWS[1]]}, "^views of scene s has 2 views named 'b'; give each its own name$"),
        ({"points": POINTS[:, :2]}, r"^points of scene s is float64 \[5, 2\], expected floats \[P, 3\]; P may be 0$"),
        ({"points": POINTS.tolist()}, r"^points of scene s is a list of 5, expected floats \[P, 3\]; P may be 0$"),
        (
            {"points": np.where([0, 1, 0], np.inf, POINTS)},
            r"^point 0 of scene s is \[0.0, inf, 0.0\]; leave it and its color out$",
        ),
        ({"point_colors": COLORS[:4]}, "^scene s has 4 point_colors for 5 points; give each point a color$"),
        ({"point_colors": COLORS.astype(np.uint8)}, r"^point_colors of scene s is uint8 \[5, 3\], expected floats"),
        ({"point_colors": 200 * COLORS}, r"^point_colors of scene s are 100 to 100, not in \[0, 1\]; divide codes"),
        ({"point_colors": COLORS * np.nan}, r"^point_colors of scene s are nan to nan, not in \[0, 1\]"),
        ({"color_matrix": np.eye(4)}, r"^color_matrix of scene s is float64 \[4, 4\], expected \[3, 3\]$"),
    ],
)
def test_fields_of_a_scene_that_cannot_be_are_named(changes, words):
    fields = {"name": "s", "format": "by hand", "views": VIEWS, "points": POINTS, "point_colors": COLORS}
    with pytest.raises((TypeError, ValueError), match=words):
        Scene(**fields | changes)


def test_a_list_of_views_becomes_a_tuple():
    assert Scene("s", "by hand", list(VIEWS), POINTS, COLORS).views == VIEWS
