"""Compressed PLY of another program, and damage."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from sehdr_warp.errors import InputError
from sehdr_warp.splats import read_gaussians, write_gaussians

from .samples import natural, pairs


def test_a_file_of_supersplat_is_near_the_plain_one(shared):
    name = "data/splats/plush_dog_point_cloud_29999_clean"
    plain, packed = (read_gaussians(shared / f"{name}{suffix}") for suffix in (".ply", ".compressed.ply"))
    index = pairs(plain, packed)
    np.testing.assert_allclose(packed.means[index], plain.means, atol=1e-3)
    assert np.abs(packed.harmonics[index][:, 1:] - plain.harmonics[:, 1:]).mean() < 0.02


@pytest.mark.parametrize(
    ("element", "cut", "problem"),
    [
        ("chunk", lambda table: table[:1], "has 1 chunks for 300 Gaussians"),
        ("sh", lambda table: table[:-1], "has harmonics of 299 of 300 Gaussians"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, element, cut, problem):
    write_gaussians(tmp_path / "a.compressed.ply", natural(300))
    parts = PlyData.read(tmp_path / "a.compressed.ply", mmap=False).elements
    parts = [PlyElement.describe(cut(each.data), element) if each.name == element else each for each in parts]
    PlyData(parts).write(tmp_path / "b.ply")
    with pytest.raises(InputError, match=problem):
        read_gaussians(tmp_path / "b.ply")
