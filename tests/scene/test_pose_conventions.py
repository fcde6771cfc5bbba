"""Cameras that a file states by another convention than the photos show."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sehdr_warp.scene import load_scene
from sehdr_warp.scene.load import parse_dataset
from sehdr_warp.scene.shared_pixels import candidate_pairs, shared_pixels

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
LARGER = 2  # Times the embedded photos, in which few features are found


@pytest.fixture(scope="module")
def views():
    return [view for view in load_scene("embedded", response="hdr-nerf").views if view.split == "train"][:14]


@pytest.fixture(scope="module")
def photos(views, tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for i, view in enumerate(views):
        codes = np.round(view.image * 255).astype(np.uint8)
        size = [LARGER * side for side in codes.shape[1::-1]]
        Image.fromarray(codes).resize(size, Image.Resampling.BICUBIC).save(folder / f"{i:02}.png")
    return folder


def link(photos, folder):
    folder.mkdir(exist_ok=True)
    for photo in photos.iterdir():
        (folder / photo.name).hardlink_to(photo)


def write_transforms(folder, photos, views, matrix_of, **lens):
    """Write transforms.json in which matrix_of(world_to_camera) stands for each photo's pose."""
    link(photos, folder)
    camera = views[0].camera
    values = {"fl_x": LARGER * camera.fx, "w": LARGER * camera.width, "h": LARGER * camera.height}
    frames = [
        {"file_path": f"{i:02}.png", "transform_matrix": matrix_of(view.camera.world_to_camera).tolist()}
        for i, view in enumerate(views)
    ]
    (folder / "transforms.json").write_text(json.dumps({**values, **lens, "frames": frames}))
    return folder


def write_llff(folder, photos, views, axes):
    """Write poses_bounds.npy of camera-to-world matrices whose columns are some axes of OpenCV's camera."""
    link(photos, folder / "images")
    rows = []
    for view in views:
        camera, pose = view.camera, np.linalg.inv(view.camera.world_to_camera)[:3]
        size = LARGER * np.array([[camera.height], [camera.width], [camera.fx]])
        rows.append([*np.hstack([pose[:, :3] @ axes, pose[:, 3:], size]).ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", rows)
    return folder


def write_colmap(folder, photos, views, pose_of):
    """Write a COLMAP model in which pose_of(world_to_camera) is a quaternion and a translation, with points."""
    link(photos, folder / "images")
    (folder / "sparse").mkdir()
    camera = views[0].camera
    numbers = (LARGER * value for value in (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy))
    (folder / "sparse/cameras.txt").write_text("1 PINHOLE {} {} {} {} {} {}\n".format(*numbers))
    lines = [
        f"{i + 1} {' '.join(map(str, np.concatenate(pose_of(view.camera.world_to_camera))))} 1 {i:02}.png\n\n"
        for i, view in enumerate(views)
    ]
    (folder / "sparse/images.txt").write_text("".join(lines))
    (folder / "sparse/points3D.txt").write_text("1 0 0 0 9 9 9 0\n2 1 1 1 9 9 9 0\n")
    return folder


def quaternion(pose):
    return np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)


def check(folder, views, words):
    dataset = parse_dataset(folder, holdout=0)
    for record, view in zip(dataset.records, views, strict=True):
        # A world may be turned as a whole; between cameras nothing may differ.
        between = record.world_to_camera @ np.linalg.inv(dataset.records[0].world_to_camera)
        right = view.camera.world_to_camera @ np.linalg.inv(views[0].camera.world_to_camera)
        np.testing.assert_allclose(between, right, atol=1e-6)
    notes = [note for note in dataset.notes if note.startswith(("poses: ", "lens: "))]
    assert [words in note for note in notes] == [True] * (words is not None)
    return dataset


@pytest.mark.parametrize(
    ("matrix_of", "words"),
    [
        (lambda pose: np.linalg.inv(pose) @ FLIP, None),
        (np.linalg.inv, "read as camera-to-world in OpenCV's axes instead"),
        (lambda pose: FLIP @ pose, "read as world-to-camera in OpenGL's axes instead"),
    ],
)
def test_poses_are_read_as_they_fit_the_photos(tmp_path, photos, views, matrix_of, words):
    check(write_transforms(tmp_path, photos, views, matrix_of), views, words)


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ([[0, 1, 0], [1, 0, 0], [0, 0, -1]], None),
        (FLIP[:3, :3], "poses_bounds.npy puts them; they are read as camera-to-world in OpenGL's axes"),
    ],
)
def test_axes_of_poses_bounds_are_found(tmp_path, photos, views, axes, words):
    check(write_llff(tmp_path, photos, views, axes), views, words)


@pytest.mark.parametrize(
    ("pose_of", "words"),
    [
        (lambda pose: (quaternion(pose), pose[:3, 3]), None),
        (lambda pose: (np.roll(quaternion(pose), -1), pose[:3, 3]), "quaternions in the order x, y, z, w"),
        (
            lambda pose: (quaternion(pose), -pose[:3, :3].T @ pose[:3, 3]),
            "rotations world-to-camera with the cameras' positions, in OpenCV's axes",
        ),
    ],
)
def test_conventions_of_other_programs_in_colmap_models_are_found(tmp_path, photos, views, pose_of, words):
    check(write_colmap(tmp_path, photos, views, pose_of), views, words)


@pytest.mark.parametrize(
    ("lens", "words"),
    [
        (lambda right: {"fl_x": 2.02 * right}, "a focal length of"),
        (lambda right: {"fl_x": 2 * right, "cx": LARGER * 160, "cy": LARGER * 160}, "a focal length of"),
        (lambda right: {"k1": 6.0}, "it is read with no distortion"),
    ],
)
def test_a_lens_that_does_not_fit_the_photos_is_mended(tmp_path, photos, views, lens, words):
    right = LARGER * views[0].camera.fx
    folder = write_transforms(tmp_path, photos, views, lambda pose: np.linalg.inv(pose) @ FLIP, **lens(right))
    record = check(folder, views, words).records[0]
    assert record.lens.focal[0] == pytest.approx(right, rel=0.015)
    assert record.lens.is_pinhole and record.lens.centre == pytest.approx([LARGER * 80] * 2, rel=0.015)


def test_a_focal_length_that_no_lens_has_does_not_refuse_the_set(tmp_path, photos, views):
    folder = write_transforms(tmp_path, photos, views, lambda pose: np.linalg.inv(pose) @ FLIP, fl_x=9.6)
    assert {record.lens.focal for record in parse_dataset(folder, holdout=0).records} == {(9.6, 9.6)}


def test_of_two_lenses_none_is_changed(tmp_path, photos, views):
    """A mistake in one of them would spoil the other."""
    folder = write_transforms(tmp_path, photos, views, lambda pose: np.linalg.inv(pose) @ FLIP)
    right = LARGER * views[0].camera.fx
    stated = json.loads((folder / "transforms.json").read_text())
    stated["frames"] = [{**frame, "fl_x": right * (1 + (i < 11))} for i, frame in enumerate(stated["frames"])]
    (folder / "transforms.json").write_text(json.dumps(stated))
    focal = [record.lens.focal[0] for record in parse_dataset(folder, holdout=0).records]
    assert focal == pytest.approx([2 * right] * 11 + [right] * 3)


def test_tiff_photos_are_compared_as_they_are_stored(tmp_path, photos, views):
    """Pillow turns a TIFF with an orientation, which a square camera does not tell to be followed."""
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "tiff").mkdir()
    for photo in photos.iterdir():
        Image.open(photo).save(tmp_path / "tiff" / photo.with_suffix(".tif").name, exif=exif)
    folder = write_transforms(tmp_path / "set", tmp_path / "tiff", views, lambda pose: np.linalg.inv(pose) @ FLIP)
    check(folder, views, None)


def test_masked_pixels_are_not_compared(tmp_path, photos, views):
    """The background of a turntable stands still, whatever the poses."""
    still = np.random.default_rng(0).integers(0, 255, (80, 80, 3), dtype=np.uint8)
    background = Image.fromarray(still).resize((LARGER * 160, LARGER * 160), Image.Resampling.BICUBIC)
    (tmp_path / "masks").mkdir()
    (tmp_path / "turned").mkdir()
    mask = Image.new("L", background.size)
    mask.paste(255, (50, 70, 270, 250))
    for i in range(len(views)):
        photo = Image.composite(Image.open(photos / f"{i:02}.png"), background, mask)
        photo.save(tmp_path / f"turned/{i:02}.png")
        mask.save(tmp_path / f"masks/{i:02}.png")
    write_transforms(tmp_path, tmp_path / "turned", views, lambda pose: np.linalg.inv(pose) @ FLIP)
    records = parse_dataset(tmp_path, holdout=0).records
    shared = list(shared_pixels(records, candidate_pairs(records)))
    poses = [[records[i].world_to_camera for i in each.indices] for each in shared]
    assert len(shared) >= 4
    assert max(each.distance(each.lenses, *pose) for each, pose in zip(shared, poses, strict=True)) < 1


def test_the_check_is_made_once_and_again_if_a_pose_changes(tmp_path, photos, views, monkeypatch):
    folder = write_transforms(tmp_path / "set", photos, views, np.linalg.inv)
    first = parse_dataset(folder, holdout=0, cache=tmp_path / "cache")
    monkeypatch.setattr("sehdr_warp.scene.pose_conventions.shared_pixels", lambda *_: iter(()))
    again = parse_dataset(folder, holdout=0, cache=tmp_path / "cache")
    assert again.notes == first.notes and any("read as camera-to-world" in note for note in again.notes)
    write_transforms(tmp_path / "other", photos, [*views[1:], views[0]], np.linalg.inv)
    assert not any("poses: " in note for note in parse_dataset(tmp_path / "other", cache=tmp_path / "cache").notes)


def test_the_check_is_made_again_once_the_size_of_the_photos_is_corrected(tmp_path, photos, views):
    lens = {"w": LARGER * 320, "h": LARGER * 320, "cx": LARGER * 80, "cy": LARGER * 80}
    poses = [tmp_path / "set", photos, views, lambda pose: np.linalg.inv(pose) @ FLIP]
    write_transforms(*poses, **lens)
    assert any(note.startswith("lens: ") for note in parse_dataset(poses[0], holdout=0, cache=tmp_path / "c").notes)
    stated = json.loads((poses[0] / "transforms.json").read_text()) | {"w": LARGER * 160, "h": LARGER * 160}
    (poses[0] / "transforms.json").write_text(json.dumps(stated))
    mended = parse_dataset(poses[0], holdout=0, cache=tmp_path / "c")
    assert mended.records[0].lens.focal[0] == pytest.approx(LARGER * views[0].camera.fx)


def test_poses_that_fit_by_no_convention_are_named(tmp_path, photos, views):
    """A set whose photos were renamed: each has the pose of another."""
    order = np.random.default_rng(1).permutation(len(views))
    shuffled = [replace(view, camera=views[k].camera) for view, k in zip(views, order, strict=True)]
    folder = write_transforms(tmp_path, photos, shuffled, lambda pose: np.linalg.inv(pose) @ FLIP)
    notes = [note for note in parse_dataset(folder, holdout=0).notes if note.startswith("poses: ")]
    assert len(notes) == 1
    assert "transforms.json fits the photos by no convention" in notes[0]
    assert "give a folder with the photos alone" in notes[0]
