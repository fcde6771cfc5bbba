"""Cameras that cannot be are refused when they are made."""

import json

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.scene import Camera, look_at
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


@pytest.mark.parametrize(
    "values, words",
    [
        ({"width": "8"}, "width is '8', expected a number"),
        ({"fx": None}, "fx is None, expected a number"),
        ({"cy": [1, 2]}, r"cy is \[1, 2\], expected a number"),
        ({"height": np.array([6, 8])}, r"height is array\(\[6, 8\]\), expected a number"),
        ({"world_to_camera": "eye"}, "world_to_camera is not a finite 4 x 4 matrix"),
        ({"world_to_camera": [[1, 2], [3]]}, "world_to_camera is not a finite 4 x 4 matrix"),
        ({"world_to_camera": np.diag([1e200, 1, 1, 1])}, "rotation of world_to_camera is not a proper rotation"),
        ({"distortion": (0.1,)}, r"distortion is \(0.1,\), expected 0 finite numbers, as pinhole has"),
        ({"distortion": None}, "distortion is None, expected 0 finite numbers"),
        ({"projection": "OPENCV_FISHEYE", "distortion": (0.1,)}, "expected 4 finite numbers, as OPENCV_FISHEYE has"),
        ({"projection": "OPENCV_FISHEYE", "distortion": "abcd"}, "distortion is 'abcd', expected 4 finite numbers"),
    ],
)
def test_values_of_another_type_are_named(values, words):
    known = {"width": 8, "height": 6, "fx": 5.0, "fy": 5.0, "cx": 4.0, "cy": 3.0, "world_to_camera": np.eye(4)}
    with pytest.raises((TypeError, ValueError), match=words):
        Camera(**known | values)


def test_numbers_of_arrays_and_tensors_make_a_camera_that_json_holds():
    expected = Camera(8, 6, 5.0, 5.0, 4.0, 3.0, np.eye(4), "OPENCV_FISHEYE", (0.5, 0.0, 0.0, 0.0))
    distortion = np.array([0.5, 0, 0, 0], np.float32)
    for K in (torch.tensor([[5.0, 0, 4], [0, 5, 3]]), np.array([[5, 0, 4], [0, 5, 3]], np.float32)):
        camera = Camera(8, 6, K[0, 0], K[1, 1], K[0, 2], K[1, 2], np.eye(4), "OPENCV_FISHEYE", distortion)
        assert json.dumps(camera.to_dict()) == json.dumps(expected.to_dict())


def test_a_pose_that_is_trained_makes_a_camera():
    pose = torch.eye(4, requires_grad=True)
    np.testing.assert_array_equal(Camera(8, 6, 5, 5, 4, 3, pose).world_to_camera, np.eye(4))


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda camera: camera.resized("8", 6), "width is '8', expected a number"),
        (lambda camera: camera.within("8"), "max_size is '8', expected a whole number"),
        (lambda camera: camera.within(0), "max_size 0 is below 1"),
    ],
)
def test_sizes_that_cannot_be_are_named(call, words):
    with pytest.raises((TypeError, SehdrError), match=words):
        call(Camera(8, 6, 5, 5, 4, 3, np.eye(4)))


@pytest.mark.parametrize(
    "points, words",
    [
        (((1, 2, 3), (1, 2, 3)), "target is the position"),
        (((0, 0, -3), (0, 0, 0), (0, 0, 2)), "up .* is parallel to the direction of view"),
        (((0, 0, -3), (0, 0, 0), (0, 0, 0)), "up .* is parallel to the direction of view"),
        (((0, 0),), r"position is \(0, 0\), expected three finite numbers"),
        (((0, float("nan"), 0),), "position is .*, expected three finite numbers"),
        (((0, 0, 1), "abc"), "target is 'abc', expected three finite numbers"),
    ],
)
def test_points_from_which_no_view_follows_are_named(points, words):
    with pytest.raises(ValueError, match=words):
        look_at(*points)
