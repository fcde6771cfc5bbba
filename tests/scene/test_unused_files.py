"""Notes on files of a set that are not used: frames, models, photos, kinds of files; and names that tools write."""

import shutil

import pytest

from sehdr_warp.errors import InputError
from tests.make_scenes import edited_json, load, said, write_blender, write_colmap, write_photos


def test_photos_in_no_view_and_unread_kinds_are_named(tmp_path):
    write_colmap(tmp_path)
    write_photos(tmp_path / "images", ["a.png", "b.jpg"], (64, 48))
    for name in ("clip.xyz", "clip2.xyz", "film.mov", "notes.txt", ".hidden.gif", "IMG.xmp"):
        (tmp_path / "images" / name).write_bytes(b"x")
    scene = load(tmp_path)
    assert said(scene, "in no view") == ["2 photos of images are in no view: a.png, b.jpg"]
    assert said(scene, "not read") == [
        "not used, because files of these kinds are not read as photos: 1 MOV (film.mov), 2 XYZ (clip2.xyz ...)"
    ]
    # More than in the model, which was not found for all
    write_photos(tmp_path / "images", [f"c{i}.png" for i in range(9)], (64, 48))
    remedy = f"; to find cameras of all photos anew, give {tmp_path / 'images'}"
    assert said(load(tmp_path), "in no view") == [
        "11 photos of images are in no view: a.png, b.jpg, c0.png ..." + remedy
    ]
    write_colmap(tmp_path / "folders", name="left/{:03d}.png")
    shutil.copytree(tmp_path / "folders/images/left", tmp_path / "folders/images/right")
    assert said(load(tmp_path / "folders"), "in no view")[0].startswith(
        "6 photos of images/right are in no view: 000.png"
    )
    shutil.copytree(tmp_path / "folders/images/left", tmp_path / "folders/images/right/more")
    (note,) = said(load(tmp_path / "folders"), "in no view")  # Not all photos lie there.
    assert note.startswith("12 photos of images/right") and "anew" not in note
    (tmp_path / "plain").mkdir()
    write_colmap(tmp_path / "plain")
    assert not said(load(tmp_path / "plain"), "in no view") and not said(load(tmp_path / "plain"), "not read")


def test_photos_that_were_not_placed_are_named_in_input_and_beside_images(tmp_path):
    write_colmap(tmp_path, name="{:03d}.png")
    for place, names in ((tmp_path, ["cover"]), (tmp_path / "input", ["000", "005", "100", "101"])):
        write_photos(place, [f"{name}.JPG" for name in names], (64, 48))
    note = f"2 photos of input are in no view: 100.JPG, 101.JPG; to find cameras of all anew, give {tmp_path / 'input'}"
    assert said(load(tmp_path), "in no view") == [note]
    write_photos(tmp_path, ["102.png"], (64, 48))
    beside = f"2 photos of {tmp_path.name} are in no view: 102.png, cover.JPG"
    assert said(load(tmp_path), "in no view") == [beside, note]


def test_pictures_of_depth_and_normals_are_named(tmp_path):
    write_colmap(tmp_path)
    for name in ("Depth", "normals", "hdr"):
        (tmp_path / name).mkdir()
    assert not said(load(tmp_path), "alone")
    write_photos(tmp_path, ["Depth/000.png", "Depth/001.png", "normals/000.png"], (64, 48))
    assert said(load(tmp_path), "alone") == [
        "not used, because depth and normals come from the photos alone: pictures of Depth (2), normals (1)"
    ]


def test_files_of_cameras_beside_photos_are_named(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "gt_cameras").mkdir()
    (tmp_path / "gt_cameras" / "000.png.camera").write_text("64 0 32\n0 64 24\n0 0 1\n0 0 0\n")
    (tmp_path / "images" / "K.txt").write_text("64 0 32\n0 64 24\n0 0 1\n")
    note = "files of cameras that are not read: K.txt, 000.png.camera"
    assert said(load(tmp_path), "cameras that") == [note]
    assert not said(load(tmp_path), "control points")
    (tmp_path / "gcp_list.txt").write_text("EPSG:32633\n400 500 90 32 24 000.png\n")
    note = "ground control points are not read: gcp_list.txt; `view` can set scale and up"
    assert said(load(tmp_path), "control points") == [note]


@pytest.mark.parametrize(("count", "others"), [(1, 9), (2, 9), (3, 31)])
def test_cameras_of_too_few_photos_of_a_folder_name_the_folder(tmp_path, count, others):
    write_colmap(tmp_path, count)
    write_photos(tmp_path / "images", [f"c{i}.png" for i in range(others)], (64, 48))
    problem = f"cameras of {count} of {count + others} photos; give {tmp_path / 'images'} to"
    with pytest.raises(InputError, match=problem):
        load(tmp_path)
    if count > 2:
        (tmp_path / "images" / "c0.png").unlink()  # Ten times as many may be what was meant.
        assert len(load(tmp_path).views) == count
        return
    write_blender(tmp_path, 7)  # Its split, and not a search for cameras, leaves few to train on.
    with edited_json(tmp_path / "transforms.json") as values:
        names = [frame["file_path"] for frame in values["frames"]]
        values |= {"train_filenames": names[:2], "val_filenames": [], "test_filenames": names[2:]}
    shutil.rmtree(tmp_path / "sparse")
    assert len(load(tmp_path).train_views) == 2


def test_links_to_files_that_are_gone_are_named(tmp_path):
    write_colmap(tmp_path)
    for name in ("x.png", "y.png"):
        (tmp_path / "images" / name).symlink_to("gone.png")
    assert said(load(tmp_path), "links lead") == ["2 links lead to no file: x.png, y.png"]


def test_a_photo_of_a_kind_that_is_not_read_is_named_as_what_it_is(tmp_path):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            (tmp_path / "images" / f"r_{i}.png").rename(tmp_path / "images" / f"r_{i}.jxl")
            (tmp_path / "images" / f"r_{i}.jxl").write_bytes(b"\xff\x0a" + bytes(100))
            frame["file_path"] += ".jxl"
    with pytest.raises(InputError, match="r_0.jxl: is JPEG XL, which is not read as a photo; export it as RGB or grey"):
        load(tmp_path)
