"""Meshroom's cameras.sfm, written as versions of AliceVision write it."""

import json

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene.dataparser import PlacedPhoto
from sehdr_warp.scene.load import parse_dataset
from tests.make_scenes import arc_poses, edited_json, write_photos

# The same lens of 64 x 48 pixels: fx 50, fy 52, center (30, 25), k1 0.1, k2 0.02, k3 0.003.
RADIAL = {"type": "radial3", "distortionParams": ["0.1", "0.02", "0.003"]}
OFFSET = {"sensorWidth": "32", "focalLength": "25", "principalPoint": ["-2", "1"]}
VERSIONS = {
    "1.2.0": {"pxFocalLength": ["50", "52"], "principalPoint": ["30", "25"], **RADIAL},
    "1.2.1": {"pxFocalLength": ["50", "52"], "principalPoint": ["-2", "1"], **RADIAL},
    "1.2.4": {**OFFSET, "pixelRatio": str(50 / 52), **RADIAL},
    "1.2.6": {**OFFSET, "pixelRatio": str(52 / 50), **RADIAL},
    "1.2.14": {**OFFSET, "pixelRatio": str(52 / 50), **RADIAL, "type": "pinhole", "distortionType": "radialk3"},
}


def write(folder, version="1.2.6", photos="photos", place="cameras.sfm", **lens):
    """Write six photos and their poses; return world-to-camera of each."""
    poses, places = arc_poses(6), [folder / photos / f"IMG_{i}.jpg" for i in range(6)]
    write_photos(folder / photos, [file.name for file in places], (64, 48))
    values = {
        "version": version.split("."),
        "views": [{"viewId": str(i), "poseId": str(i), "intrinsicId": "7", "path": f"D:/shots/{file.name}"}
                  for i, file in enumerate(places)],
        "intrinsics": [{"intrinsicId": "7", "width": "64", "height": "48", **VERSIONS[version], **lens}],
        "poses": [{"poseId": str(i), "pose": {"transform": {
            "rotation": [str(value) for value in pose[:3, :3].T.ravel()],
            "center": [str(value) for value in np.linalg.inv(pose)[:3, 3]]}}} for i, pose in enumerate(poses)],
    }  # fmt: skip
    (folder / place).parent.mkdir(parents=True, exist_ok=True)
    (folder / place).write_text(json.dumps(values))
    return poses


@pytest.mark.parametrize("version", VERSIONS)
def test_poses_and_lenses_of_every_version(tmp_path, version):
    poses = write(tmp_path, version)
    dataset = parse_dataset(tmp_path)
    assert dataset.format == "meshroom" and [record.view for record in dataset.records] == [
        f"IMG_{i}" for i in range(6)
    ]
    for record, pose in zip(dataset.records, poses, strict=True):
        np.testing.assert_allclose(record.world_to_camera, pose, atol=1e-9)
        np.testing.assert_allclose(record.lens.params, (50, 52, 30, 25, 0.1, 0.02, 0, 0, 0.003, 0, 0, 0))
        assert record.lens.model == "FULL_OPENCV"


@pytest.mark.parametrize("kind, numbers, model, params", [
    ("pinhole", "", "FULL_OPENCV", [0] * 8),
    ("radial1", [0.1], "FULL_OPENCV", [0.1, 0, 0, 0, 0, 0, 0, 0]),
    ("brown", [0.1, 0.02, 0.003, 4e-4, 5e-4], "FULL_OPENCV", [0.1, 0.02, 4e-4, 5e-4, 0.003, 0, 0, 0]),
    ("fisheye4", [0.1, 0.02, 0.003, 4e-4], "OPENCV_FISHEYE", [0.1, 0.02, 0.003, 4e-4]),
])  # fmt: skip
def test_distortion(tmp_path, kind, numbers, model, params):
    write(tmp_path, type=kind, distortionParams=numbers and [str(number) for number in numbers])
    lens = parse_dataset(tmp_path).records[0].lens
    assert lens.model == model
    np.testing.assert_allclose(lens.params[4:], params)


@pytest.mark.parametrize("place", ["sfm.json", "MeshroomCache/StructureFromMotion/0a1b/cameras.sfm"])
def test_other_places_of_the_file(tmp_path, place):
    write(tmp_path, photos=".", place=place)
    (tmp_path / "cameraInit.sfm").write_text('{"views": [{"intrinsicId": "7"}]}')  # The node before, without poses
    dataset = parse_dataset(tmp_path)
    assert dataset.format == "meshroom" and len(dataset.records) == 6
    lens, pose = dataset.records[0].lens, np.eye(4)
    cameras = [PlacedPhoto(f"IMG_{i}.jpg", lens, pose, "train", 1.0) for i in range(6)]
    bare = parse_dataset(tmp_path, cameras=cameras)
    assert bare.format == "photos", "a run found its cameras before the file was there"
    assert not any("poses of" in note for note in bare.notes)


def test_what_cannot_be_used_is_named(tmp_path):
    write(tmp_path)
    (tmp_path / "photos/IMG_0.jpg").unlink()
    with edited_json(tmp_path / "cameras.sfm") as values:
        values["views"][1]["rigId"] = "3"
        del values["poses"][2]
    dataset = parse_dataset(tmp_path)
    assert [record.view for record in dataset.records] == ["IMG_3", "IMG_4", "IMG_5"]
    for words in ("pose of 'IMG_1.jpg' cannot be used (cameras of rigs are not read)", "1 of 6 photos have no pose",
                  "have no photo and were left out: IMG_0.jpg"):  # fmt: skip
        assert any(words in note for note in dataset.notes), words
    write(tmp_path, type="3deradial4")
    with pytest.raises(InputError, match="lens of 'IMG_0.jpg' is of type '3deradial4', which is not read; use radial3"):
        parse_dataset(tmp_path)
    endless = {"rotation": [10**400] * 9, "center": [0] * 3}
    poses = [{"poseId": str(i), "pose": {"transform": endless}} for i in range(6)]
    for change in ({"intrinsics": []}, {"poses": [{"poseId": []}]}, {"poses": poses}, {"views": ["a"]},
                   {"version": "new"}, {"version": [float("inf")]}):  # fmt: skip
        write(tmp_path)
        with edited_json(tmp_path / "cameras.sfm") as values:
            values |= change
        with pytest.raises(InputError, match=r"cameras\.sfm"):
            parse_dataset(tmp_path)
    write(tmp_path)
    for photo in (tmp_path / "photos").iterdir():
        photo.unlink()
    with pytest.raises(InputError, match="none of the 6 photos with a pose in cameras.sfm is here"):
        parse_dataset(tmp_path)
