"""Poses that files state: rotations, scales, rows and columns."""

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from tests.make_scenes import edited_json, load, write_blender


@pytest.mark.parametrize("sides, problem", [((1, 1, -1), "mirrors the scene"), ((2, 2, 1), r"stretch \[2.0, 2.0, 1.0")])
def test_poses_that_are_no_rotations_are_refused(tmp_path, sides, problem):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for frame in values["frames"]:
            frame["transform_matrix"] = np.diag([*sides, 1.0]).tolist()
    with pytest.raises(InputError, match=problem):
        load(tmp_path)


def test_the_scale_of_a_camera_is_left_out(tmp_path):
    """Blender scales cameras as it shows them, and matrix_world has that scale."""
    write_blender(tmp_path)
    plain = load(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for frame in values["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([0.4, 0.4, 0.4, 1])).tolist()
    for view, scaled in zip(plain.views, load(tmp_path).views, strict=True):
        np.testing.assert_allclose(scaled.camera.world_to_camera, view.camera.world_to_camera, atol=1e-9)


def test_transposed_poses_are_refused(tmp_path):
    """ARKit and USD keep matrices by columns: all photos would be at one place."""
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for frame in values["frames"]:
            frame["transform_matrix"] = np.array(frame["transform_matrix"]).T.tolist()
    with pytest.raises(InputError, match=r"r_0' has the last row \[.*, 1.0\], not 0 0 0 1; transpose the matrix"):
        load(tmp_path)
