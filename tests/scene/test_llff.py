"""LLFF's plain `poses_bounds.npy`: its axes, its image size and its refusals."""

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from tests.make_scenes import arc_poses, load, pattern


def write_llff(folder, count=6, size=(64, 48), focal=50.0):
    """images/ and poses_bounds.npy as LLFF's imgs2poses writes them; returns the world_to_camera matrices."""
    (folder / "images").mkdir()
    poses, rows = arc_poses(count), []
    for i, pose in enumerate(poses):
        Image.fromarray(pattern(*size, seed=i)).save(folder / "images" / f"{i:03d}.png")
        camera_to_world = np.linalg.inv(pose)
        right, down, forward, position = camera_to_world[:3].T
        matrix = np.stack([down, right, -forward, position, [size[1], size[0], focal]], axis=1)
        rows.append([*matrix.ravel(), 1.0, 10.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return poses


def test_axes_size_and_focal_length_are_llffs(tmp_path):
    poses = write_llff(tmp_path)
    scene = load(tmp_path)
    assert scene.format == "llff"
    views = sorted(scene.views, key=lambda view: view.name)
    assert [view.name for view in views] == [f"{i:03d}" for i in range(6)]
    for i, (view, pose) in enumerate(zip(views, poses, strict=True)):
        np.testing.assert_allclose(view.camera.world_to_camera, pose, atol=1e-9)
        assert (view.camera.width, view.camera.height, view.camera.fx, view.camera.cx) == (64, 48, 50.0, 32.0)
        np.testing.assert_allclose(view.image, pattern(64, 48, seed=i) / 255, atol=1e-6)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: rows[:-1], "5 rows for 6 images"),
        (lambda rows: rows[:, :-1], "is not an \\[n, 17\\] array"),
        (lambda rows: np.where(np.arange(17) == 3, np.nan, rows), "is not finite"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, spoil, message):
    write_llff(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", spoil(np.load(tmp_path / "poses_bounds.npy")))
    with pytest.raises(InputError, match=message):
        load(tmp_path)
