"""Poses and bounds of LLFF."""

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from tests.make_scenes import load, pattern, write_colmap, write_llff


def test_llffs_axes_size_and_focal_length(tmp_path):
    poses = write_llff(tmp_path)
    scene = load(tmp_path, cache=tmp_path / "cache")
    assert scene.format == "llff" and [view.name for view in scene.views] == [f"{i:03d}" for i in range(6)]
    for i, (view, pose) in enumerate(zip(scene.views, poses, strict=True)):
        np.testing.assert_allclose(view.camera.world_to_camera, pose, atol=1e-9)
        assert (view.camera.width, view.camera.height, view.camera.fx, view.camera.cx) == (64, 48, 50.0, 32.0)
        np.testing.assert_allclose(view.image, pattern(64, 48, seed=i) / 255, atol=1e-6)


def test_a_model_without_images_does_not_hide_the_poses_of_llff(tmp_path):
    write_llff(tmp_path)
    write_colmap(tmp_path / "other", binary=True)
    (tmp_path / "sparse").mkdir()
    (tmp_path / "other" / "sparse" / "0").rename(tmp_path / "sparse" / "0")
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    scene = load(tmp_path, holdout=0)
    assert scene.views[0].camera.fx == pytest.approx(50)
    assert [note for note in scene.notes if "sparse" in note] == [
        "sparse/0 has no images.bin or images.txt: its cameras are not used"
    ]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: rows[:-1], "5 rows for 6 images"),
        (lambda rows: rows[:, :-1], "is not an \\[n, 17\\] array"),
        (lambda rows: np.where(np.arange(17) == 3, np.nan, rows), "is not finite"),
    ],
)
def test_llff_rows_that_do_not_fit_are_refused(tmp_path, spoil, message):
    write_llff(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", spoil(np.load(tmp_path / "poses_bounds.npy")))
    with pytest.raises(InputError, match=message):
        load(tmp_path)
