"""Gaussians as arrays: positions stay precise, and a transform that a file states can be undone."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sehdr_warp.errors import InputError
from sehdr_warp.output.world_transform import WorldTransform
from sehdr_warp.splats import read_gaussians, write_gaussians
from sehdr_warp.splats.arrays import join_gaussians

from .samples import gaussians


def test_positions_stay_precise_in_map_coordinates():
    near, moved = gaussians(), np.array([5e5, 5.4e6, 100.0])
    matrix = np.eye(4)
    matrix[:3, 3] = moved
    far = near.transformed(matrix)
    np.testing.assert_allclose(far.means - moved, near.means, atol=1e-8)
    assert near.transformed(np.eye(4)).means.dtype == np.float32


def test_a_far_sky_does_not_make_the_positions_of_a_scene_coarse(tmp_path, logged):
    """float32 moves Gaussians of the sky by 0.01 of the others' size, and by 1e-5 of their own."""
    near, matrix = gaussians(), np.eye(4)
    near = replace(near, log_scales=np.full((50, 3), np.log(0.005), np.float32))
    sky = replace(near, means=400 * near.means, log_scales=np.full((50, 3), np.log(4), np.float32))
    matrix[:3, :3] = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix()
    turned = join_gaussians([*[near] * 12, sky]).transformed(matrix)
    write_gaussians(tmp_path / "a.ply", turned)
    assert turned.means.dtype == np.float32 and not any("too large for the float32" in line for line in logged)


@pytest.mark.parametrize("matrix", [np.diag([0, 0, 0, 1]), np.diag([1, 1, 1.0003, 1]), np.diag([1, 1, -1, 1])])
def test_a_transform_that_cannot_be_undone_is_refused_as_the_file_is_read(tmp_path, matrix):
    """Files with a matrix that is no similarity are refused when they are read, not when they are placed."""
    write_gaussians(tmp_path / "a.ply", replace(gaussians(5), world_matrix=matrix.astype(float)))
    with pytest.raises(InputError, match=r"a\.ply: its world_matrix (does not keep|is not)"):
        read_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize("scale", [1e6, 1e-6])
def test_the_largest_scales_of_an_export_are_read_again_and_undone(tmp_path, scale):
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_euler("xyz", [1.1, 0.4, 2.3]).as_matrix()
    for part, world in ((1, matrix), (2, matrix @ matrix)):  # Exported, and exported again
        write_gaussians(tmp_path / f"{part}.ply", replace(gaussians(5), world_matrix=world))
        read = read_gaussians(tmp_path / f"{part}.ply")
        undone = WorldTransform.from_matrix(read.world_matrix).inverse().matrix @ world
        np.testing.assert_allclose(undone, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("comment", ["world_matrix [[1, 2]", "world_matrix [1]", "world_matrix [1" + 400 * "0" + "]"])
def test_a_transform_that_is_no_matrix_is_named_in_plain_words(tmp_path, comment):
    write_gaussians(tmp_path / "a.ply", replace(gaussians(5), world_matrix=np.diag([2.0, 2, 2, 1])))
    content = re.sub(rb"world_matrix .*", comment.encode(), (tmp_path / "a.ply").read_bytes(), count=1)
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match="its world_matrix is not an affine 4 x 4 matrix; leave"):
        read_gaussians(tmp_path / "a.ply")
