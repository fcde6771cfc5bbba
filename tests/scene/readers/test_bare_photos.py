"""Folders as phones, cameras and other programs leave them: what is read, and what is named instead."""

import json
import os
import shutil
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
from sehdr_warp.scene.readers.bare_photos import find_photos, with_cameras
from sehdr_warp.scene.readers.colmap_model import ModelImage, SparseModel
from sehdr_warp.scene.sfm.reconstruction import Reconstruction
from sehdr_warp.scene.unused_files import unused_notes
from tests.make_scenes import arc_poses, edited_json, load, pattern, write_blender, write_colmap, write_ply


def photos(folder, count=4, suffix=".jpg"):
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        Image.fromarray(pattern(16, 12, i)).save(folder / f"IMG_{i}{suffix}")


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
    Image.fromarray(pattern(16, 12)).save(poly / "thumbnail.jpg")
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
        for i in range(count):
            (place := tmp_path / "DCIM" / name).mkdir(parents=True, exist_ok=True)
            Image.fromarray(pattern(16, 12, 5 * count + i)).save(place / f"IMG_{i}.jpg")
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
    for i in range(3):
        Image.fromarray(pattern(16, 12, 10 + i)).save(tmp_path / f"mesh{i}.jpg")
    dataset = find_photos(tmp_path)
    assert [record.image.parent.name for record in dataset.records] == ["images"] * 5
    others = "are not read, because there are more in"
    assert f"3 photos of {tmp_path.name} {others} images: mesh0.jpg, mesh1.jpg, mesh2.jpg" in dataset.notes
    photos(tmp_path / "input", 6)
    assert any(note.startswith(f"5 photos of images {others} input: ") for note in find_photos(tmp_path).notes)


def test_depth_and_confidence_beside_photos_are_not_photos(tmp_path):
    """The 3D Scanner App writes all data so; a photo may have such a word in its name."""
    photos(tmp_path)
    Image.fromarray(pattern(16, 12, 9)).save(tmp_path / "depth_of_field.jpg")
    for i in range(9):
        Image.fromarray(pattern(8, 6, i)[..., 0].astype(np.uint16) << 4).save(tmp_path / f"depth_{i}.png")
        Image.fromarray(pattern(8, 6, i)[..., 0]).save(tmp_path / f"frame-{i}.confidence.png")
    dataset = find_photos(tmp_path)
    assert [record.view for record in dataset.records] == [*(f"IMG_{i}" for i in range(4)), "depth_of_field"]
    note = "18 pictures called depth, confidence or normals are left out: depth_0.png, depth_1.png,"
    assert any(each.startswith(note) for each in dataset.notes)
    assert unused_notes(tmp_path, dataset.records, dataset.mentioned) == []


def test_grey_photos_of_a_conference_room_are_photos(tmp_path):
    for i in range(4):
        Image.fromarray(pattern(16, 12, i)[..., 0]).save(tmp_path / f"conf_room_{i}.png")
    dataset = find_photos(tmp_path)
    assert len(dataset.records) == 4 and dataset.notes == ()


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


@pytest.mark.parametrize("change", ["null model", "text numbers", "flat pose", "mark", "matrix", "all in one folder"])
def test_transforms_as_apps_write_them(tmp_path, change):
    write_blender(tmp_path, 6)
    file = tmp_path / "transforms.json"
    before, values = load(tmp_path, holdout=0), json.loads(file.read_text())
    if change == "null model":
        values["camera_model"] = None
    elif change == "text numbers":
        values |= {"w": "40", "h": "30", "camera_angle_x": str(values["camera_angle_x"])}
    elif change == "flat pose":
        values["frames"] = [
            frame | {"transform_matrix": np.ravel(frame["transform_matrix"]).tolist()} for frame in values["frames"]
        ]
    elif change == "matrix":
        focal = 20 / np.tan(values.pop("camera_angle_x") / 2)  # Of photos of 40 x 30 pixels
        matrix = [[focal, 0, 20], [0, focal, 15], [0, 0, 1]]
        values["frames"] = [frame | {"K": matrix} for frame in values["frames"]]
    elif change == "all in one folder":
        for photo in (tmp_path / "images").iterdir():
            photo.rename(tmp_path / photo.name)
        (tmp_path / "images").rmdir()
    file.write_bytes(b"\xef\xbb\xbf" * (change == "mark") + json.dumps(values).encode())
    scene = load(tmp_path, holdout=0)
    for view, other in zip(scene.views, before.views, strict=True):
        np.testing.assert_array_equal(view.camera.world_to_camera, other.camera.world_to_camera)
        assert view.camera.intrinsics == pytest.approx(other.camera.intrinsics)
        assert (view.camera.fx, view.camera.width) == (other.camera.fx, other.camera.width)


@pytest.mark.parametrize("value", ["", "wide", "nan", "inf"])
def test_text_that_is_no_number_is_named(tmp_path, value):
    write_blender(tmp_path, 6, fl_x=value)
    with pytest.raises(InputError, match=f"fl_x = '?{value}'? is not a finite number"):
        load(tmp_path)


def test_masks_and_points_that_are_missing_are_named(tmp_path):
    write_blender(tmp_path, 6, ply_file_path="sparse_pc.ply")
    file = tmp_path / "transforms.json"
    with edited_json(file) as values:
        values["frames"][1]["mask_path"] = "masks/r_1.png"
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6
    assert "1 mask that a frame states is not here, and its photo counts whole: r_1.png" in scene.notes
    assert "the points that transforms.json states are not here: 'sparse_pc.ply'" in scene.notes


@pytest.mark.parametrize("before", ["./m/", "m\\", "/home/other/room/m/", "C:\\room\\m\\"])
def test_masks_and_points_under_other_spellings(tmp_path, before):
    """instant-DexNerf issue 3 and exports of Windows: photos were found by such names, masks and points were not."""
    write_blender(tmp_path, 6, ply_file_path=f"{before}cloud.ply")
    (tmp_path / "m").mkdir()
    write_ply(tmp_path / "m" / "cloud.ply", [(0, 0, 0), (1, 2, 3)])
    file = tmp_path / "transforms.json"
    with edited_json(file) as values:
        for i, frame in enumerate(values["frames"]):
            frame["mask_path"] = f"{before}half_{i}.png" if i else ""
            Image.fromarray(np.eye(30, 40, dtype=np.uint8) * 255).save(tmp_path / "m" / f"half_{i}.png")
    scene = load(tmp_path, holdout=0)
    assert [view.mask is None for view in scene.views] == [True] + [False] * 5
    assert "not here" not in str(scene.notes) and len(scene.points) == 2


def test_splits_under_other_spellings(tmp_path):
    """nerfstudio compares its lists of names as paths: `./images/r_0` is `images/r_0`."""
    names = [f"images/r_{i}" for i in range(6)]
    write_blender(tmp_path, 6, train_filenames=names[:4], test_filenames=["./" + names[4], names[5].replace("/", "\\")])
    assert [view.name for view in load(tmp_path).test_views] == ["r_4", "r_5"]


def test_a_lens_that_is_not_supported_is_named_before_its_focal_length(tmp_path):
    write_blender(tmp_path, 6, camera_model="VR180_L", camera_angle_x=None)
    with pytest.raises(InputError, match="camera_model 'VR180_L' is not supported"):
        load(tmp_path)


def test_copies_in_another_kind_of_file_are_left_out_and_named(tmp_path):
    """The kind that may hold more counts, also if a copy is turned; a photo of the same name is no copy."""
    for i in range(5):
        photo = Image.fromarray(pattern(96, 64, i))
        photo.save(tmp_path / f"IMG_{i}.png")
        turned = Image.Exif()
        turned[0x0112] = 6
        if i < 3:
            Image.fromarray(np.rot90(np.asarray(photo))).resize((32, 48)).save(
                tmp_path / f"img_{i}.JPG", quality=70, exif=turned
            )
    Image.fromarray(pattern(96, 64, 9)).save(tmp_path / "IMG_4.jpg")
    (tmp_path / "IMG_3.jpg").write_bytes(b"damaged")
    dataset = find_photos(tmp_path)
    names = [record.image.name for record in dataset.records]
    assert sorted(names) == ["IMG_0.png", "IMG_1.png", "IMG_2.png", "IMG_3.jpg", "IMG_3.png", "IMG_4.jpg", "IMG_4.png"]
    assert not any("no view" in note for note in unused_notes(tmp_path, dataset.records, dataset.mentioned))
    (note,) = dataset.notes
    assert note.startswith("3 photos are copies of others and left out: img_0.JPG of IMG_0.png")


def test_copies_of_the_same_bytes_are_left_out_and_named(tmp_path):
    for i in range(4):
        Image.fromarray(pattern(96, 64, i)).save(tmp_path / f"IMG_{i}.jpg")
    shutil.copy(tmp_path / "IMG_2.jpg", tmp_path / "IMG_2 (1).jpg")
    dataset = find_photos(tmp_path)
    assert [record.image.name for record in dataset.records] == [f"IMG_{i}.jpg" for i in range(4)]
    assert dataset.notes == ("1 photo is a copy of others and left out: IMG_2 (1).jpg of IMG_2.jpg",)


@pytest.mark.parametrize("edited", ["IMG_E{}.jpg", "img_e{}.HEIC", "IMG_{}-edited.jpg"])
def test_edited_photos_beside_their_originals_are_left_out_and_named(tmp_path, edited):
    """Check edited photos as phones name them: of another tone they are copies, of another picture they are photos."""
    for i in range(4):
        Image.fromarray(pattern(96, 64, i)).save(tmp_path / f"IMG_{i}.jpg")
        brighter = np.minimum(pattern(96, 64, i if i < 3 else 9) * 1.2, 255).astype(np.uint8)
        Image.fromarray(brighter).save(tmp_path / edited.format(i), "PNG")
    dataset = find_photos(tmp_path)
    names = {record.image.name for record in dataset.records}
    assert names == {*(f"IMG_{i}.jpg" for i in range(4)), edited.format(3)}
    assert dataset.notes == (f"3 photos are copies of others and left out: {edited.format(0)} of IMG_0.jpg ...",)


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
