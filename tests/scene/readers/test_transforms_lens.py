"""Lenses of transforms.json."""

import json

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene.readers.transforms import read_transforms
from tests.make_scenes import edit_transforms, edited_json, load, write_blender


@pytest.mark.parametrize(
    "fields, model, bent",
    [
        (
            {"camera_model": "FULL_OPENCV", "p1": 1e-3} | {f"k{n}": n / 10 for n in range(1, 7)},
            "FULL_OPENCV",
            (0.1, 0.2, 1e-3, 0, 0.3, 0.4, 0.5, 0.6),
        ),
        ({"k1": 0.1, "k3": 0.3}, "FULL_OPENCV", (0.1, 0, 0, 0, 0.3, 0, 0, 0)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "OPENCV_FISHEYE", (0.1, 0, 0, 0.4)),
        ({"camera_model": "SIMPLE_RADIAL_FISHEYE", "k1": 0.1}, "OPENCV_FISHEYE", (0.1, 0, 0, 0)),
        ({"is_fisheye": True, "k1": 0.1, "k2": 0.2}, "OPENCV_FISHEYE", (0.1, 0.2, 0, 0)),
    ],
)
def test_distortion_by_camera_model(tmp_path, fields, model, bent):
    """nerfstudio issues 3355 and 3611, instant-ngp pull request 1147: k4 to k6 differ between programs."""
    write_blender(tmp_path, fl_x=50.0, **fields)
    lens = read_transforms(tmp_path).records[0].lens
    assert lens.model == model and lens.params[4:] == pytest.approx(bent)


@pytest.mark.parametrize("name", ["k4", "k5", "k6"])
def test_distortion_whose_meaning_is_open_is_refused(tmp_path, name):
    write_blender(tmp_path, **{"k1": 0.1, name: 0.2})
    with pytest.raises(InputError, match=f"{name} = 0.2 of camera_model OPENCV has no one meaning; state camera_model"):
        load(tmp_path)


def test_intrinsics_of_frames_alone_and_in_degrees(tmp_path):
    """LichtFeld-Studio pull request 1608, nerfstudio issue 737."""
    write_blender(tmp_path, exposure_time=0.25)
    with edited_json(tmp_path / "transforms.json") as values:
        del values["camera_angle_x"]
        for frame in values["frames"]:
            frame |= {"x_fov": np.degrees(0.8), "w": 40, "h": 30, "cx": 19.0}
    view = load(tmp_path).views[0]
    assert view.camera.fx == view.camera.fy == pytest.approx(20 / np.tan(0.4)) and view.camera.cx == 19
    assert view.exposure_time == 0.25


def test_a_focal_length_or_angle_counts_beside_a_matrix_of_another_size(tmp_path):
    matrix = [[0.5, 0, 0.5], [0, 0.6, 0.5], [0, 0, 1]]
    write_blender(tmp_path, fl_x=60.0, K=matrix)
    assert tuple(load(tmp_path).views[0].camera.intrinsics) == (60, 60, 20, 15)
    write_blender(tmp_path, K=matrix)
    assert load(tmp_path).views[0].camera.fx == pytest.approx(20 / np.tan(0.4))
    write_blender(tmp_path, camera_angle_x=None, K=[[[1], 0, 0], [0, 1, 0], [0, 0, 1]])
    with pytest.raises(InputError, match="no focal length"):
        load(tmp_path)


def test_distortion_as_a_list(tmp_path):
    bent = {"k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}
    write_blender(tmp_path / "a", 2, **bent)
    write_blender(tmp_path / "b", 2)
    frames = json.loads((tmp_path / "b" / "transforms.json").read_text())["frames"]
    params = [bent.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")]
    edit_transforms(tmp_path / "b", frames=[frame | {"distortion_params": params} for frame in frames])
    lenses = [read_transforms(tmp_path / name).records[1].lens for name in "ab"]
    assert lenses[0].params == lenses[1].params and lenses[0].model == "OPENCV"


def test_a_lens_that_is_not_supported_is_named_before_its_focal_length(tmp_path):
    write_blender(tmp_path, 6, camera_model="VR180_L", camera_angle_x=None)
    with pytest.raises(InputError, match="camera_model 'VR180_L' is not supported"):
        load(tmp_path)
