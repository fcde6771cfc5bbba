"""Copies of photos, edited ones, and pictures of depth and normals."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene.readers.bare_photos import find_photos
from sehdr_warp.scene.readers.photo_copies import find_copies
from sehdr_warp.scene.unused_files import unused_notes
from tests.make_scenes import load, pattern, write_blender, write_photos

from .test_bare_photos import photos


@pytest.mark.parametrize("new", [0, 2])
@pytest.mark.parametrize("place", ["images", "test"])
def test_photos_that_are_trained_on_are_not_held_out(tmp_path, place, new):
    """A test split of the training photos, by name or as copies, tests nothing; its own photos stay."""
    write_blender(tmp_path, 11)
    values = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").unlink()
    if place != "images":
        shutil.copytree(tmp_path / "images", tmp_path / place)
    tested = [frame | {"file_path": frame["file_path"].replace("images", place)} for frame in values["frames"]]
    for split, frames in (("train", values["frames"][: 11 - new]), ("test", tested)):
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(values | {"frames": frames}))
    scene = load(tmp_path)
    assert any(line.startswith(f"{11 - new} test photos are training photos, too") for line in scene.notes), scene.notes
    assert [view.name[-3:] for view in scene.test_views] == (["r_9", "_10"] if new else ["r_4"])
    assert len(scene.train_views) == (9 if new else 10)


def test_depth_and_confidence_beside_photos_are_not_photos(tmp_path):
    """The 3D Scanner App writes all data so; a photo may have such a word in its name."""
    photos(tmp_path)
    write_photos(tmp_path, ["depth_of_field.jpg"], seed=9)
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


def test_one_of_two_files_of_the_same_bytes_stays_whatever_their_kinds(tmp_path):
    """The shorter name is the original of its copy, although its kind of file would be preferred less."""
    write_photos(tmp_path, ["IMG_0.jpg", "IMG_1.jpg"], (96, 64))
    shutil.copy(tmp_path / "IMG_0.jpg", tmp_path / "IMG_0.tiff")
    files = sorted(tmp_path.iterdir())
    assert find_copies(files) == {tmp_path / "IMG_0.tiff": tmp_path / "IMG_0.jpg"}


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
    write_photos(tmp_path, ["IMG_4.jpg"], (96, 64), 9)
    (tmp_path / "IMG_3.jpg").write_bytes(b"damaged")
    dataset = find_photos(tmp_path)
    names = [record.image.name for record in dataset.records]
    assert sorted(names) == ["IMG_0.png", "IMG_1.png", "IMG_2.png", "IMG_3.jpg", "IMG_3.png", "IMG_4.jpg", "IMG_4.png"]
    assert not any("no view" in note for note in unused_notes(tmp_path, dataset.records, dataset.mentioned))
    (note,) = dataset.notes
    assert note.startswith("3 photos are copies of others and left out: img_0.JPG of IMG_0.png")


def test_a_photo_of_the_same_name_that_shows_a_little_more_of_one_side_is_no_copy(tmp_path):
    for i in range(4):
        picture = pattern(98, 64, i)
        Image.fromarray(picture[:, :96]).save(tmp_path / f"IMG_{i}.png")
        Image.fromarray(picture[:, 2 * (i > 0) :][:, :96]).save(tmp_path / f"IMG_{i}.jpg")
    dataset = find_photos(tmp_path)
    assert len(dataset.records) == 7
    assert dataset.notes == ("1 photo is a copy of others and left out: IMG_0.jpg of IMG_0.png",)


def test_copies_of_the_same_bytes_are_left_out_and_named(tmp_path):
    write_photos(tmp_path, [f"IMG_{i}.jpg" for i in range(4)], (96, 64))
    shutil.copy(tmp_path / "IMG_2.jpg", tmp_path / "IMG_2 (1).jpg")
    dataset = find_photos(tmp_path)
    assert [record.image.name for record in dataset.records] == [f"IMG_{i}.jpg" for i in range(4)]
    assert dataset.notes == ("1 photo is a copy of others and left out: IMG_2 (1).jpg of IMG_2.jpg",)


@pytest.mark.parametrize("edited", ["IMG_E{}.jpg", "img_e{}.HEIC", "IMG_{}-edited.jpg"])
def test_edited_photos_beside_their_originals_are_left_out_and_named(tmp_path, edited):
    """Check edited photos as phones name them: of another tone they are copies, of another picture they are photos."""
    write_photos(tmp_path, [f"IMG_{i}.jpg" for i in range(4)], (96, 64))
    for i in range(4):
        brighter = np.minimum(pattern(96, 64, i if i < 3 else 9) * 1.2, 255).astype(np.uint8)
        Image.fromarray(brighter).save(tmp_path / edited.format(i), "PNG")
    dataset = find_photos(tmp_path)
    names = {record.image.name for record in dataset.records}
    assert names == {*(f"IMG_{i}.jpg" for i in range(4)), edited.format(3)}
    assert dataset.notes == (f"3 photos are copies of others and left out: {edited.format(0)} of IMG_0.jpg ...",)


def test_pictures_of_depth_and_normals_beside_photos_of_their_names_are_not_photos(tmp_path):
    """They may be colored."""
    kinds = ("{}_rgb.png", "{}_normal.png", "{}_depth.png")
    write_photos(tmp_path, [kind.format(i) for kind in kinds for i in range(4)])
    dataset = find_photos(tmp_path)
    assert [record.view for record in dataset.records] == [f"{i}_rgb" for i in range(4)]
    (note,) = dataset.notes
    assert note.startswith("8 pictures called depth, confidence or normals are left out: 0_depth.png, 0_normal.png")
    write_photos(tmp_path, ["normal_lens.png"], seed=20)
    assert find_photos(tmp_path).records[-1].view == "normal_lens"


def test_photos_of_a_run_whose_names_are_upper_case_stay(tmp_path):
    photo, copy = tmp_path / "IMG_1.PNG", tmp_path / "c.png"
    write_photos(tmp_path, [photo.name])
    shutil.copy(photo, copy)
    assert find_copies([photo, copy]) == {photo: copy}
    assert find_copies([photo, copy], [photo.name]) == {copy: photo}
