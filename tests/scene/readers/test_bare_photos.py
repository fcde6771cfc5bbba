"""Folders as phones, cameras and other programs leave them: what is read, and what is named instead."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.dataparser import UNPLACED, DataparserOutputs, ImageRecord, PlacedPhoto, PointCloud
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.load import parse_dataset
from sehdr_warp.scene.photo_names import photo_labels
from sehdr_warp.scene.readers import bare_photos
from sehdr_warp.scene.readers.bare_photos import find_photos, inner_folder, with_cameras
from sehdr_warp.scene.readers.colmap_model import ModelImage, SparseModel
from sehdr_warp.scene.sfm.reconstruction import Reconstruction, image_name
from tests.make_scenes import arc_poses, load, pattern, write_blender, write_colmap, write_photos


def photos(folder, count=4, suffix=".jpg"):
    write_photos(folder, [f"IMG_{i}{suffix}" for i in range(count)])


def files(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x" * 64)


NOT_PHOTOS = {
    "a.insp": "holds 1 INSP .*; export them from the camera's program as equirectangular",
    "a.360": "holds 1 360 .*; export them from the camera's program as equirectangular",
    "a.GPR": "holds 1 GPR .*; give photos .JPEG",
    "capture.zip": "no known layout; unpack capture.zip, and give the folder with its photos",
    "walk.MOV": "holds 1 MOV .*; give the clip itself: walk.MOV",
    "camera.dcp": "holds 1 DCP",
}


@pytest.mark.parametrize("name", NOT_PHOTOS)
def test_what_to_give_in_place_of_a_folder_without_photos(tmp_path, name):
    files(tmp_path, name)
    with pytest.raises(InputError, match=NOT_PHOTOS[name]):
        parse_dataset(tmp_path)


def test_an_archive_is_to_be_unpacked(tmp_path):
    files(tmp_path, "scan.zip")
    with pytest.raises(InputError, match="scan.zip: is an archive; unpack it, and give the folder with its photos"):
        parse_dataset(tmp_path / "scan.zip")


def test_photos_deep_in_an_export_are_read(tmp_path):
    """A COLMAP set two folders down; Polycam's raw export, a thumbnail beside keyframes, has poses to decide about."""
    poly = tmp_path / "poly"
    photos(poly / "keyframes" / "corrected_images")
    photos(poly / "keyframes" / "depth")
    write_photos(poly, ["thumbnail.jpg"])
    files(poly, "mesh_info.json")
    remedy = "give .* with photos: keyframes/corrected_images; poses of Polycam"
    with pytest.raises(InputError, match=f"is the only photo there; {remedy}"):
        parse_dataset(poly)
    write_colmap(tmp_path / "work" / "dense" / "1")
    dataset = parse_dataset(tmp_path / "work")
    assert dataset.format == "colmap" and dataset.name == "work"
    assert "photos are read from dense/1, the only folder with photos" in dataset.notes
    (tmp_path / "work" / "clip.mp4").touch()  # Perhaps the photos' source, perhaps what was meant.
    with pytest.raises(InputError, match="give one of its folders with photos: dense/1$"):
        parse_dataset(tmp_path / "work")


def test_photos_in_several_folders_belong_into_one(tmp_path):
    photos(tmp_path / "left")
    photos(tmp_path / "right")
    with pytest.raises(InputError, match="photos: left, right; or put photos of one scene into one folder$"):
        parse_dataset(tmp_path)


def test_a_folder_of_more_photos_is_named_beside_two_pictures(tmp_path):
    for folder, count in (("a", 1), ("images", 2), ("renders", 5)):
        photos(tmp_path / folder, count)
    remedy = "give one of its folders with photos: renders, images, a; or put"
    with pytest.raises(InputError, match=f"images/IMG_0.jpg: is one of only 2 photos there; {remedy}"):
        find_photos(tmp_path)


@pytest.mark.parametrize("names", [("100CANON", "101CANON"), ("202409__", "202410_a")])
def test_folders_of_one_camera_are_one_set(tmp_path, names):
    """A memory card: numbers of files begin again in the second folder."""
    for count, name in zip((4, 2), names, strict=True):
        write_photos(tmp_path / "DCIM" / name, [f"IMG_{i}.jpg" for i in range(count)], seed=5 * count)
    files(tmp_path, "MISC/a.ctg")
    dataset = find_photos(tmp_path)
    first, second = (f"DCIM/{name}" for name in names)
    assert f"photos are read from the folders of one camera: {first} (4), {second} (2)" in dataset.notes
    views = [f"{names[0]}_IMG_0", f"{names[0]}_IMG_1", "IMG_2", "IMG_3", f"{names[1]}_IMG_0", f"{names[1]}_IMG_1"]
    assert [record.view for record in dataset.records] == views
    lens = Lens("SIMPLE_PINHOLE", 16, 12, (20.0, 8, 6), tmp_path)
    run = [0, 2, 3, 4, 5]  # IMG_1.jpg of the first folder could not be placed.
    labels = photo_labels([dataset.records[index].image for index in run])
    cameras = [PlacedPhoto(label, lens, i * np.eye(4), "train", 1.0) for i, label in zip(run, labels, strict=True)]
    placed = parse_dataset(tmp_path, cameras=cameras)
    assert [record.world_to_camera[0, 0] for record in placed.records] == run
    assert [record.image for record in placed.records] == [dataset.records[index].image for index in run]
    assert f"1 photo is not in the run and is left out: {names[0]}/IMG_1.jpg" in placed.notes
    one = parse_dataset(tmp_path / first, cameras=cameras[:3])  # Not as of several folders
    assert [record.world_to_camera[0, 0] for record in one.records] == run[:3]


def test_folders_of_two_cameras_are_not_joined(tmp_path):
    photos(tmp_path / "100CANON")
    photos(tmp_path / "100NIKON")
    with pytest.raises(InputError, match="give one of its folders with photos: 100CANON, 100NIKON; or put"):
        parse_dataset(tmp_path)


def test_photos_as_3dgs_convert_expects_them(tmp_path):
    photos(tmp_path / "input")
    assert [record.image.parent.name for record in find_photos(tmp_path).records] == ["input"] * 4


def test_fewer_pictures_of_results_lie_beside_the_photos(tmp_path):
    photos(tmp_path / "images", 5)
    write_photos(tmp_path, [f"mesh{i}.jpg" for i in range(3)], seed=10)
    dataset = find_photos(tmp_path)
    assert [record.image.parent.name for record in dataset.records] == ["images"] * 5
    others = "are not read, because there are more in"
    assert f"3 photos of {tmp_path.name} {others} images: mesh0.jpg, mesh1.jpg, mesh2.jpg" in dataset.notes
    photos(tmp_path / "input", 6)
    assert any(note.startswith(f"5 photos of images {others} input: ") for note in find_photos(tmp_path).notes)


@pytest.mark.parametrize("file, tool", [
    ("cameras.xml", "Metashape"), ("bundle.out", "Bundler"), ("mesh_info.json", "Polycam"),
    ("Registration.csv", "RealityCapture"), ("frame_00000.json", "3D Scanner App"),
    ("dinoSR_par.txt", "Middlebury"), ("pose.txt", "TUM"),
])  # fmt: skip
def test_poses_of_other_programs_are_named(tmp_path, file, tool):
    photos(tmp_path)
    (tmp_path / "annotations.json").write_text("{}")  # Beside the poses of 3D Scanner App
    os.mkfifo(tmp_path / "a.xml")  # It would block a reader for ever
    (tmp_path / file).write_text('{"cameraPoseARFrame": []}')
    assert any(f"poses of {tool} ({file}) are not read" in note for note in find_photos(tmp_path).notes)


@pytest.mark.parametrize("file, content, tool", [
    ("views.json", '{"views": [{"intrinsicId": "1"}]}', "Meshroom"), ("a.json", '{"sfm_data_version": 1}', "OpenMVG"),
    ("dense.nvm", "NVM_V3", "VisualSFM"), ("bundle/a.out", "# Bundle file v0.3", "Bundler"),
    ("project.xml", "<document><chunk></chunk></document>", "Metashape"),
    ("castle.csv", "#name,x,y,alt,heading,pitch,roll,f\n", "RealityScan"),
    ("IMG_0.xmp", '<rdf:Description xcr:Version="3"/>', "RealityScan"),
    ("room.txt", "# timestamp tx ty tz qx qy qz qw\n0.1 1 2 3 0 0 0 1\n", "TUM"),
])  # fmt: skip
def test_poses_of_other_programs_are_known_by_their_content(tmp_path, file, content, tool):
    photos(tmp_path)
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text("<x/>")
    assert not find_photos(tmp_path).notes
    (tmp_path / file).write_text(content)
    name = Path(file).name
    assert any(note.startswith(f"poses of {tool} ({name}) are not read") for note in find_photos(tmp_path).notes)


def test_a_photo_whose_camera_is_uncertain_is_not_held_out(tmp_path, monkeypatch):
    photos(tmp_path, 9)
    lens = Lens("PINHOLE", 16, 12, (14.0, 14.0, 8.0, 6.0), Path("cameras.bin"))
    images = tuple(ModelImage(f"{i:05d}.png", lens, pose) for i, pose in enumerate(arc_poses(9)))
    model = SparseModel(images, PointCloud(np.zeros((1, 3)), np.zeros((1, 3), np.float32)))
    monkeypatch.setattr(bare_photos, "reconstruct", lambda *args: Reconstruction(model, 0.5, (3, 4)))
    scene = load_scene(tmp_path, response="srgb")
    assert [view.name for view in scene.test_views] == ["IMG_5"] and scene.unplaced == 0
    assert [view.name for view in scene.views if view.uncertain] == ["IMG_3", "IMG_4"]


def test_poses_of_other_programs_are_the_remedy_if_cameras_are_not_found(tmp_path):
    photos(tmp_path, 3)
    files(tmp_path, "cameras.xml")
    with pytest.raises(InputError, match=r"be placed.*; poses of Metashape \(cameras.xml\).*nerfstudio"):
        parse_dataset(tmp_path)
    photos(tmp_path / "shots", 4)  # The others may be pictures of results.
    with pytest.raises(InputError, match=r"be placed.*; if the photos are in a folder of it, give that: shots; poses"):
        parse_dataset(tmp_path)


def test_exports_of_record3d_are_named(tmp_path):
    photos(tmp_path / "rgb", 3)
    files(tmp_path, "metadata.json")
    with pytest.raises(InputError, match="folders with photos: rgb; poses of Record3D"):
        parse_dataset(tmp_path)


@pytest.mark.parametrize("place", ["@eaDir/000.png/SYNOPHOTO_THUMB_M.jpg", "__MACOSX/000.jpg", "#recycle/1.jpg"])
def test_folders_that_systems_keep_are_no_photos(tmp_path, place):
    write_colmap(tmp_path)
    files(
        tmp_path,
        f"images/{place}",
        "images/._000.png",
        "images/.DS_Store",
        "images/Thumbs.db",
        "images/.IMG_1.HEIC.icloud",
    )
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6 and not any("in no view" in note or "not used" in note for note in scene.notes)


@pytest.mark.parametrize("suffix", [".jfif", ".jpe", ".mpo"])
def test_jpegs_under_their_other_suffixes(tmp_path, suffix):
    for i in range(3):
        Image.fromarray(pattern(96, 64, i)).save(tmp_path / f"{i}{suffix}", "JPEG")
    assert len(find_photos(tmp_path).records) == 3


def test_the_folder_of_photos_in_place_of_its_set(tmp_path):
    write_colmap(tmp_path)
    (note,) = find_photos(tmp_path / "images").notes
    assert note.endswith(f"sparse/0 are not used, cameras are found anew: give {tmp_path} for them")
    with pytest.raises(InputError, match=f"known layout; give {tmp_path}"):
        find_photos(tmp_path / "sparse")


def test_transforms_of_any_name_are_named_in_a_folder_and_read_as_a_file(tmp_path):
    write_blender(tmp_path)
    file = (tmp_path / "transforms.json").rename(tmp_path / "undistorted.json")
    assert find_photos(tmp_path).notes == ("undistorted.json states cameras: to use them, give the file itself",)
    dataset = parse_dataset(file)
    assert (dataset.format, dataset.folder, len(dataset.records)) == ("transforms", tmp_path, 6)


def test_cameras_of_a_run_are_found_by_names_in_other_case_or_form_of_an_accent(tmp_path):
    """Disks of cameras and Macs change names so; where names differ in case alone, each photo has its own camera."""
    lens = Lens("SIMPLE_PINHOLE", 16, 12, (16.0, 8.0, 6.0), tmp_path)
    kept = ["Schlo\u00df \u00e9.jpg", "a.JPG", "a.jpg", "b.JPG"]
    cameras = [PlacedPhoto(name, lens, index * np.eye(4), "train", 1.0) for index, name in enumerate(kept)]
    now = ["Schlo\u00df e\u0301.jpg", "a.jpg", "a.JPG", "b.jpg"]
    records = tuple(ImageRecord(Path(name).stem, tmp_path / name, UNPLACED, np.eye(4)) for name in now)
    dataset, others = with_cameras(DataparserOutputs("photos", records), cameras)
    assert not others and [record.world_to_camera[0, 0] for record in dataset.records] == [0, 2, 1, 3]
    assert not dataset.notes


def test_folders_far_below_count_if_none_is_near(tmp_path):
    for place in (tmp_path / "kitti/2011_09_26/drive_0001/image_02/data", tmp_path / "kitti/photos"):
        photos(place)
        assert inner_folder(tmp_path) == place


def test_a_folder_of_a_set_beside_the_photos_is_named(tmp_path):
    write_blender(tmp_path / "nerfstudio_data", 4)
    for place in (tmp_path / "images", tmp_path / "images_2"):
        photos(place)
    assert find_photos(tmp_path).notes == ("photos in folders of it are not read: nerfstudio_data",)


def test_photos_are_found_beside_a_cover_and_named_in_folders(tmp_path):
    for name in ("day/1.png", "day/2.png", "day/3.png", "text/note.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="day/1.png"):  # It is empty, and found all the same.
        load(tmp_path)
    (tmp_path / "day").rename(tmp_path / "images")
    (tmp_path / "cover.jpg").touch()
    with pytest.raises(InputError, match="images/1.png"):
        load(tmp_path)


@pytest.mark.parametrize(
    "photos, weak, turn, expected", [(6, (), 0, 6), (4, (1,), 0, 6), (4, (), 0, 4), (6, (), 0.2, 4)]
)
def test_whole_photos_are_used_if_they_place_more_and_agree_with_masks(
    photos, weak, turn, expected, monkeypatch, caplog
):
    """Masks place four photos, whole photos six, whose cameras turn otherwise if an object turns before them."""
    lens = Lens("PINHOLE", 8, 6, (7.0, 7.0, 4.0, 3.0), Path("cameras.bin"))

    def reconstruction(poses, weak=()):
        images = tuple(ModelImage(image_name(i), lens, pose) for i, pose in enumerate(poses))
        cloud = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
        return Reconstruction(SparseModel(images, cloud), 0.5, weak)

    def turned(angle):
        sine, cosine = np.sin(angle), np.cos(angle)
        return np.array([[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]])

    inside = reconstruction(arc_poses(6)[:4], weak)
    whole = reconstruction([turned(i * turn) @ pose @ turned(0.7) for i, pose in enumerate(arc_poses(6))])
    monkeypatch.setattr(bare_photos, "reconstruct", lambda photos, cache, masks=(): inside if masks else whole)
    files = [Path(f"{i}.jpg") for i in range(photos)]
    assert len(bare_photos.reconstruct_with_masks(files, None, files).model.images) == expected
    assert ("and cameras agree" in caplog.text) == (expected == 6)


def test_masks_count_if_whole_photos_place_no_more_than_they(monkeypatch, caplog):
    lens = Lens("PINHOLE", 8, 6, (7.0, 7.0, 4.0, 3.0), Path("cameras.bin"))
    images = tuple(ModelImage(image_name(i), lens, np.eye(4)) for i in range(4))
    cloud = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    by_masks = {masks: Reconstruction(SparseModel(images, cloud), 0.5, ()) for masks in (True, False)}
    monkeypatch.setattr(bare_photos, "reconstruct", lambda photos, cache, masks=(): by_masks[bool(masks)])
    files = [Path(f"{i}.jpg") for i in range(12)]
    assert bare_photos.reconstruct_with_masks(files, None, files) is by_masks[True] and not caplog.text
