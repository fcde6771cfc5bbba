"""Cameras that cannot be are refused when they are made."""

import numpy as np
import pytest

from sehdr_warp.scene import Camera
from sehdr_warp.scene.camera import limited_size


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"fx": 0.0}, "not positive"),
        ({"fy": -5.0}, "not positive"),
        ({"fx": 1e-300}, "between 0.001 and 1e"),
        ({"fy": 1e30}, "between 0.001 and 1e"),
        ({"cx": np.nan}, "not finite"),
        ({"width": 0}, "not positive"),
        ({"width": 4.5}, "4.5 x 6 is not in whole pixels"),
        ({"width": np.inf}, "inf x 6 is not in whole pixels"),
        ({"width": 1 << 21}, "more than 1048576 pixels"),
        ({"world_to_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "not a proper rotation"),
        ({"world_to_camera": np.eye(3)}, "4 x 4"),
    ],
)
def test_an_impossible_camera_is_refused(values, problem):
    camera = {"width": 8, "height": 6, "fx": 9.0, "fy": 9.0, "cx": 4.0, "cy": 3.0, "world_to_camera": np.eye(4)}
    assert Camera(**camera).fx == 9.0
    with pytest.raises(ValueError, match=problem):
        Camera(**camera | values)


def test_half_a_size_is_a_size():
    camera = Camera(8, 6, 9.0, 9.0, 4.0, 3.0, np.eye(4))
    half = camera.resized(8 / 2, np.int64(3))
    assert (half.width, half.height) == (4, 3) and type(half.width) is type(half.height) is int


def test_limited_size():
    assert limited_size(2832, 2128, 400) == (400, 301) and limited_size(30, 20, 400) == (30, 20)
    assert limited_size(5000, 2, 100) == (100, 1) and limited_size(30, 20, None) == (30, 20)
