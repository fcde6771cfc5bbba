"""Poses that a file states by another convention than the photos show."""

import json

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene import load_scene
from sehdr_warp.scene.load import parse_dataset

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def views():
    return [view for view in load_scene("embedded").views if view.split == "train"]


def write(folder, views, matrix_of):
    """Write transforms.json without points, in which matrix_of(world_to_camera) stands for each photo's pose."""
    frames = []
    for i, view in enumerate(views):
        size = [4 * side for side in view.codes.shape[1::-1]]
        codes = np.round(view.image * 255).astype(np.uint8)
        Image.fromarray(codes).resize(size, Image.Resampling.BICUBIC).save(folder / f"{i:02}.png")
        frames.append({"file_path": f"{i:02}.png", "transform_matrix": matrix_of(view.camera.world_to_camera).tolist()})
    camera = views[0].camera
    values = {"fl_x": 4 * camera.fx, "fl_y": 4 * camera.fy, "w": size[0], "h": size[1], "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values))
    return folder


@pytest.mark.parametrize(
    ("matrix_of", "words"),
    [
        (lambda pose: np.linalg.inv(pose) @ FLIP, None),
        (np.linalg.inv, "read as camera-to-world in OpenCV's axes instead"),
        (lambda pose: pose, "read as world-to-camera in OpenCV's axes instead"),
        (lambda pose: FLIP @ pose, "read as world-to-camera in OpenGL's axes instead"),
    ],
)
def test_poses_are_read_as_they_fit_the_photos(tmp_path, views, matrix_of, words):
    dataset = parse_dataset(write(tmp_path, views, matrix_of), holdout=0)
    for record, view in zip(dataset.records, views, strict=True):
        np.testing.assert_allclose(record.world_to_camera, view.camera.world_to_camera, atol=1e-9)
    notes = [note for note in dataset.notes if note.startswith("poses: ")]
    assert [words in note for note in notes] == [True] * (words is not None)


def test_poses_that_fit_by_no_convention_are_named(tmp_path, views):
    """A set whose photos were renamed: each has the pose of another."""
    shuffled = [view.camera.world_to_camera for view in views]
    poses = iter([*shuffled[7:], *shuffled[:7]][::-1])
    dataset = parse_dataset(write(tmp_path, views, lambda _: np.linalg.inv(next(poses)) @ FLIP), holdout=0)
    assert any("they do not fit the photos, by no convention" in note for note in dataset.notes)
