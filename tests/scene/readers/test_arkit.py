"""Scans of phones, written as 3D Scanner App and Polycam do."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene.dataparser import PlacedPhoto
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.load import parse_dataset
from sehdr_warp.scene.readers.arkit import find_scan
from sehdr_warp.scene.readers.bare_photos import find_photos
from tests.make_scenes import arc_poses, pattern

LENS = (50.0, 52.0, 30.0, 25.0)


def write(folder, app, **changes):
    """Write six photos and their poses; return world-to-camera of each."""
    images, cameras = {"polycam": ("keyframes/corrected_images", "keyframes/corrected_cameras")}.get(app, (".", "."))
    poses = arc_poses(6)
    for i, pose in enumerate(poses):
        for place in (images, cameras):
            (folder / place).mkdir(parents=True, exist_ok=True)
        Image.fromarray(pattern(64, 48, i)).save(folder / images / f"frame_{i:05d}.jpg")
        matrix = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
        fx, fy, cx, cy = LENS
        if app == "polycam":
            values = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
            values |= dict(zip(("fx", "fy", "cx", "cy"), LENS, strict=True)) | {"width": 64, "height": 48}
        else:
            Image.fromarray(pattern(8, 6, i)[..., 0]).save(folder / f"conf_{i:05d}.png")
            values = {"cameraPoseARFrame": matrix.ravel().tolist(), "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1]}
        (folder / cameras / f"frame_{i:05d}.json").write_text(json.dumps(values | changes))
    return poses


@pytest.mark.parametrize("app", ["scanner", "polycam"])
def test_poses_and_lenses_of_apps(tmp_path, app):
    poses = write(tmp_path, app)
    dataset = parse_dataset(tmp_path)
    assert dataset.format == "arkit" and [record.view for record in dataset.records] == [
        f"frame_{i:05d}" for i in range(6)
    ]
    for record, pose in zip(dataset.records, poses, strict=True):
        np.testing.assert_allclose(record.world_to_camera, pose, atol=1e-9)
        assert record.lens.params == LENS and (record.lens.width, record.lens.height) == (64, 48)
    assert any(note.startswith("6 pictures called depth") for note in dataset.notes) == (app == "scanner")
    assert not any("in no view" in note for note in dataset.notes)


def test_frames_without_a_photo_are_named_and_damaged_ones_refused(tmp_path):
    """3D Scanner App saves a photo for one pose of three."""
    write(tmp_path, "scanner")
    (tmp_path / "frame_00001.jpg").unlink()
    assert "1 of 6 frames have no photo and were left out: frame_00001" in parse_dataset(tmp_path).notes
    write(tmp_path, "scanner", intrinsics=[1, 2])
    with pytest.raises(InputError, match="frame_00000.json: states no usable pose and lens"):
        parse_dataset(tmp_path)


def test_a_run_with_cameras_of_its_own_keeps_them(tmp_path):
    """It may have found them before the poses were copied there."""
    write(tmp_path, "scanner")
    lens = Lens("SIMPLE_PINHOLE", 64, 48, (20.0, 32, 24), tmp_path)
    cameras = [PlacedPhoto(f"frame_{i:05d}.jpg", lens, i * np.eye(4), "train", 1.0) for i in range(6)]
    dataset = parse_dataset(tmp_path, cameras=cameras)
    assert dataset.format == "photos" and not any("not read" in note for note in dataset.notes)
    assert [record.world_to_camera[0, 0] for record in dataset.records] == list(range(6))


def test_photos_of_which_two_have_a_pose_are_bare(tmp_path):
    """A set may have a few frames of a scan beside its photos."""
    write(tmp_path, "scanner")
    for file in sorted(tmp_path.glob("*.json"))[2:]:
        file.unlink()
    assert find_scan(tmp_path) is None
    assert len(find_photos(tmp_path).records) == 6


def test_a_scan_is_found_in_a_folder_and_named_if_its_photos_alone_are_given(tmp_path):
    write(tmp_path / "scan", "polycam")
    shutil.copytree(tmp_path / "scan/keyframes/corrected_images", tmp_path / "scan/keyframes/images")
    dataset = parse_dataset(tmp_path)
    assert dataset.format == "arkit" and dataset.folder == tmp_path / "scan/keyframes"
    photos = tmp_path / "scan/keyframes/corrected_images"
    note = f"cameras of {photos.with_name('corrected_cameras')} are not used"
    assert any(each.startswith(note) for each in find_photos(photos).notes)
