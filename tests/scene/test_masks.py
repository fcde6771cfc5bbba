"""Masks in every layout: found by name, read by value, counted in a note."""

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene import Camera
from sehdr_warp.scene.file_names import list_images
from sehdr_warp.scene.masks import assign_masks, read_mask
from sehdr_warp.scene.readers.bare_photos import find_photos
from tests.make_scenes import (
    RadianceView,
    arc_poses,
    edited_json,
    load,
    pattern,
    write_blender,
    write_colmap,
    write_llff,
    write_photos,
    write_reinhard,
)

HALF = np.repeat(np.array([[0], [255]], np.uint8), 24, axis=0).repeat(64, axis=1)
"""[48, 64]: the upper half is left out."""


def write_mask(path, mask=HALF):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(path)


def shares(scene):
    return [1.0 if view.mask is None else round(float(view.mask.mean()), 2) for view in scene.views]


def masks_said(scene):
    return [note for note in scene.notes if "mask" in note]


@pytest.mark.parametrize(
    "name",
    [
        "masks/{}.png.png", "masks/{}.png", "masks/{}.jpg", "masks/{}.PNG", "masks/{}_mask.png", "masks/{}.mask.png",
        "masks/mask_{}.png", "mask/{}.png", "masks/images/{}.png", "images/{}_mask.png", "images/masks/{}.png",
        "images/{}-removebg.png", "images_mask/{}-removebg-preview.png", "Masks/{}.png",
    ],
)  # fmt: skip
def test_names_of_masks(tmp_path, name):
    write_colmap(tmp_path)
    for i in range(6):
        write_mask(tmp_path / name.format(f"{i:03d}"))
    scene = load(tmp_path, holdout=0)
    assert shares(scene) == [0.5] * 6
    assert masks_said(scene) == ["masks: 6 of 6 photos have one; they leave out 50.0 % of their pixels"]


@pytest.mark.parametrize("name", ["images/dynamic_mask_{}.png", "masks/dynamic_mask_{}.png"])
def test_masks_of_instant_ngp_leave_out_what_is_not_black(tmp_path, name):
    write_colmap(tmp_path)
    color = np.zeros((48, 64, 3), np.uint8)
    color[:12, :, 2] = 1  # A quarter, by the faintest code of one channel
    for i in range(6):
        write_mask(tmp_path / name.format(f"{i:03d}"), color)
    scene = load(tmp_path, holdout=0)
    assert shares(scene) == [0.75] * 6
    assert not scene.views[0].mask[:12].any()
    assert scene.views[0].mask[12:].all()
    assert not any("in no view" in note for note in scene.notes)


def test_masks_of_instant_ngp_are_not_bare_photos(tmp_path):
    for i in range(6):
        Image.new("RGB", (64, 48), (40 * i, 9, 9)).save(tmp_path / f"{i}.jpg")
        write_mask(tmp_path / f"dynamic_mask_{i}.png")
    write_mask(tmp_path / "dynamic_mask_of_nothing.png")  # Without its photo it is one.
    assert [record.image.name for record in find_photos(tmp_path).records] == [
        *(f"{i}.jpg" for i in range(6)),
        "dynamic_mask_of_nothing.png",
    ]


def test_masks_of_photos_in_folders_of_same_names(tmp_path):
    write_colmap(tmp_path, name="cam{0}/0000.png")
    write_mask(tmp_path / "masks" / "cam1" / "0000.png")
    write_mask(tmp_path / "masks" / "cam2" / "0000.png.png")
    scene = load(tmp_path, holdout=0)
    assert shares(scene) == [1.0, 0.5, 0.5, 1.0, 1.0, 1.0]
    write_mask(tmp_path / "masks" / "0000.png")  # It could be any camera's.
    scene = load(tmp_path, holdout=0)
    assert shares(scene) == [1.0, 0.5, 0.5, 1.0, 1.0, 1.0]
    assert "masks/ holds 1 file that fits no photo: 0000.png; name each like its photo" in masks_said(scene)[0]


@pytest.mark.parametrize("name", ["masks/IMG_Ä{}.PNG", "masks/img_a\u0308{}.png.png", "images/Img_Ä{}_mask.png"])
def test_case_and_forms_of_accents_do_not_matter_in_names_of_masks(tmp_path, name):
    write_colmap(tmp_path, name="img_ä{}.png")
    for i in range(6):
        write_mask(tmp_path / name.format(i))
    assert shares(load(tmp_path, holdout=0)) == [0.5] * 6


def test_folders_and_files_that_look_like_masks_are_named(tmp_path):
    write_colmap(tmp_path)
    for folder in ("dynamic_masks", "Segmentation", "masks", "masks_2"):
        write_mask(tmp_path / folder / "000.png")
    Image.new("L", (64, 48)).save(tmp_path / "masks" / "001.gif")
    assert masks_said(load(tmp_path, holdout=0)) == [
        "masks/ holds 1 file of kinds that are not read as masks: 001.gif; use PNG",
        "Segmentation/ is not read: if it holds masks of the photos, name it masks/",
        "dynamic_masks/ is not read: if it holds masks of the photos, name it masks/",
        "masks: 1 of 6 photos have one; they leave out 50.0 % of their pixels",
    ]


def test_a_folder_of_masks_that_frames_state_is_not_named(tmp_path):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            frame["mask_path"] = f"segmentation/{i}.png"
            write_mask(tmp_path / "segmentation" / f"{i}.png", HALF[4:44, 4:34].T)
    assert masks_said(load(tmp_path, holdout=0)) == [
        "masks: 6 of 6 photos have one; they leave out 50.0 % of their pixels"
    ]


def test_masks_that_fit_no_photo_are_named(tmp_path):
    write_colmap(tmp_path)
    for i in range(5):
        write_mask(tmp_path / "masks" / f"frame{i}.png")
    write_mask(tmp_path / "masks" / "000.png")
    (tmp_path / "images" / "unregistered.png").write_bytes((tmp_path / "images" / "000.png").read_bytes())
    write_mask(tmp_path / "masks" / "unregistered.png")  # Its photo is there, and is named elsewhere.
    strange, counted = masks_said(load(tmp_path, holdout=0))
    assert strange.startswith("masks/ holds 5 files that fit no photo: frame0.png, frame1.png, frame2.png ...; name")
    assert counted.startswith("masks: 1 of 6 photos have one; they leave out 50.0 %")


def test_masks_of_hdr_nerf_by_view_and_by_exposure(tmp_path):
    views = [
        RadianceView(f"r_{i}", Camera(64, 48, 50, 50, 32, 24, pose), pattern(64, 48, seed + i) / 100.0, split)
        for seed, split in ((0, "train"), (3, "test"))
        for i, pose in enumerate(arc_poses(3))
    ]
    write_reinhard(tmp_path, views, [0.5, 1.0, 2.0])
    write_mask(tmp_path / "masks" / "train" / "r_0.png")
    write_mask(tmp_path / "masks" / "test" / "r_1_1.png")
    write_mask(tmp_path / "masks" / "r_2.png")  # It could be of train or of test.
    scene = load(tmp_path)
    assert {view.name for view in scene.views if view.mask is not None} == {"train_r_0", "r_1"}
    assert "fits no photo: r_2.png" in masks_said(scene)[0]


def test_masks_of_bare_photos_beside_them_are_no_photos(tmp_path):
    write_llff(tmp_path)
    for i in range(6):
        write_mask(tmp_path / "images" / f"{i:03d}_mask.png")
    Image.fromarray(HALF).save(tmp_path / "images" / "gas_mask.png")  # A photo of one.
    assert [file.name for file in list_images(tmp_path / "images", (".png",))] == [
        *(f"{i:03d}.png" for i in range(6)),
        "gas_mask.png",
    ]


@pytest.mark.parametrize(
    "mask",
    [
        HALF // 255,
        HALF // 2,
        HALF.astype(np.uint16) * 257,
        HALF.astype(np.uint16),
        HALF > 0,
        np.dstack([HALF // 255, HALF * 0, HALF * 0]),
        np.dstack([HALF * 0, HALF * 0, HALF * 0, HALF]),
    ],
    ids=["0 and 1", "0 and 127", "16 bits", "8 bits in 16", "one bit", "label color", "alpha"],
)
def test_two_values_are_read_as_colmap_reads_them(tmp_path, mask):
    write_mask(tmp_path / "mask.png", mask)
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), HALF / 255)


def test_color_counts_where_alpha_hardly_varies(tmp_path):
    mask = np.dstack([HALF, HALF, HALF, np.full_like(HALF, 255)])
    mask[0, 3, 3] = 254
    write_mask(tmp_path / "mask.png", mask)
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), HALF / 255)
    cut_out = np.dstack([pattern(64, 48, 0).astype(np.uint8), HALF])
    write_mask(tmp_path / "cut_out.png", cut_out)
    np.testing.assert_array_equal(read_mask(tmp_path / "cut_out.png"), HALF / 255)


def test_labels_keep_their_pixels_and_are_named(tmp_path):
    labels = HALF // 255
    labels[30:] = 2
    write_colmap(tmp_path)
    for i in range(2):
        write_mask(tmp_path / "masks" / f"{i:03d}.png", labels)
    np.testing.assert_array_equal(read_mask(tmp_path / "masks" / "000.png"), HALF / 255)
    scene = load(tmp_path, holdout=0)
    assert shares(scene) == [0.5] * 2 + [1.0] * 4
    assert masks_said(scene)[1] == "masks: 2 hold labels up to 31; every label above 0 keeps its pixels"


def test_weights_and_masks_of_one_value(tmp_path):
    for values, expected in (([0, 51, 255], [0, 0.2, 1]), ([51, 255, 255], [0.2, 1, 1]), ([0] * 3, [0] * 3),
                             ([1] * 3, [1] * 3), ([255] * 3, [1] * 3), ([102] * 3, [0.4] * 3)):  # fmt: skip
        write_mask(tmp_path / "mask.png", np.array([values], np.uint8))
        np.testing.assert_allclose(read_mask(tmp_path / "mask.png")[0], expected, atol=1e-6)


@pytest.mark.parametrize("name", ["masks", "mask", "old_masks", "hdr"])
def test_folders_that_lead_out_of_the_set_are_not_searched(tmp_path, name):
    write_colmap(tmp_path / "set")
    (tmp_path / "outside").mkdir()
    write_mask(tmp_path / "outside" / "strange.png")
    (tmp_path / "set" / name).symlink_to(tmp_path / "outside")
    if name == "old_masks":
        assert not any("old_masks" in note for note in load(tmp_path / "set").notes)
    else:
        with pytest.raises(InputError, match="outside the data folder"):
            load(tmp_path / "set")


def test_masks_of_another_size_of_the_same_shape(tmp_path):
    write_colmap(tmp_path)
    write_mask(tmp_path / "masks" / "000.png", HALF[::2, ::2])
    write_mask(tmp_path / "masks" / "001.png", HALF.repeat(2, 0).repeat(2, 1))
    scene = load(tmp_path, holdout=0)
    assert shares(scene) == pytest.approx([0.5] * 2 + [1.0] * 4)
    np.testing.assert_array_equal(scene.views[1].mask, HALF / 255)


def test_a_photo_whose_mask_cannot_be_used_is_left_out(tmp_path):
    write_colmap(tmp_path)
    write_mask(tmp_path / "masks" / "000.png", HALF[:30])
    (tmp_path / "masks" / "001.png").write_bytes(b"no picture")
    scene = load(tmp_path, holdout=0)
    (note,) = (note for note in scene.notes if "left out" in note)
    assert len(scene.views) == 4 and "2 of 6 photos cannot be used and were left out (masks/000.png: mask is 64" in note
    for i in range(6):
        write_mask(tmp_path / "masks" / f"{i:03d}.png", HALF[:30])
    with pytest.raises(InputError, match="mask is 64 x 30, its image 64 x 48; make the mask at the image's size"):
        load(tmp_path)


@pytest.mark.parametrize("name", ["mask.png", "camera_mask.jpg"])
def test_one_mask_of_all_photos(tmp_path, name):
    write_colmap(tmp_path)
    write_mask(tmp_path / name)
    write_mask(tmp_path / "masks" / "002.png", np.full((48, 64), 255, np.uint8))
    scene = load(tmp_path, holdout=0)
    assert shares(scene) == [0.5, 0.5, 1.0, 0.5, 0.5, 0.5], "a photo's own mask counts"
    write_mask(tmp_path / name, HALF[:, :40])
    assert shares(load(tmp_path, holdout=0)) == [1.0] * 6, "a mask of another shape is no mask of these photos"


def test_masks_that_leave_out_everything_are_named(tmp_path):
    write_colmap(tmp_path)
    for photo in (tmp_path / "images").iterdir():
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.new("L", (64, 48)).save(tmp_path / "masks" / photo.name)
    with pytest.raises(InputError, match="masks or transparency leave out all pixels .*; masks keep what is white"):
        load(tmp_path)


def test_masks_in_a_folder_of_each_camera(tmp_path):
    write_colmap(tmp_path, name="cam{0}/0000.png")
    write_mask(tmp_path / "images" / "cam1" / "masks" / "0000.png")
    scene = load(tmp_path, holdout=0)
    assert shares(scene) == [1.0, 0.5, 1.0, 1.0, 1.0, 1.0]
    assert not any("in no view" in note for note in scene.notes)


@pytest.mark.parametrize("place", ["", "images"])
def test_a_mask_of_all_photos_lies_among_bare_photos(tmp_path, place):
    """A photo may have its name."""
    folder = tmp_path / place
    write_photos(folder, [*(f"{i}.jpg" for i in range(4)), "mask.png"], (64, 48))
    assert [record.view for record in find_photos(tmp_path).records] == ["0", "1", "2", "3", "mask"]
    write_mask(folder / "mask.png", HALF)
    records, _ = assign_masks(find_photos(tmp_path).records, tmp_path)
    assert [(record.view, record.mask) for record in records] == [(str(i), folder / "mask.png") for i in range(4)]
    Image.fromarray(pattern(48, 64, 0)).save(folder / "0.jpg")
    records, _ = assign_masks(find_photos(tmp_path).records, tmp_path)
    assert [record.mask is None for record in records] == [True, False, False, False], "one is of another shape"
