"""COLMAP sets against pycolmap; test_bad_scenes and fuzz hold what damaged or hostile ones get."""

import shutil

import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene.readers.bare_photos import find_photos
from sehdr_warp.scene.readers.colmap import model_fits, read_colmap
from tests.make_scenes import load, write_colmap, write_photos

pycolmap = pytest.importorskip("pycolmap")


@pytest.mark.parametrize(
    "place, photos",
    [
        (".", "images"),
        (".", "Images"),
        ("model", "images"),
        ("model", "input"),
        ("Sparse/0", "images"),
        ("Sparse/0", "."),
    ],
)
def test_models_and_photos_are_found_in_other_folders_by_the_names_of_the_photos(tmp_path, place, photos):
    write_colmap(tmp_path, name="{:03d}.png")
    model = (tmp_path / "sparse" / "0").rename(tmp_path / "before")
    (tmp_path / "sparse").rmdir()
    images = (tmp_path / "images").rename(tmp_path / "photos_before")
    for source, target in ((model, tmp_path / place), (images, tmp_path / photos)):
        target.mkdir(parents=True, exist_ok=True)
        for file in source.iterdir():
            file.rename(target / file.name)
        source.rmdir()
    scene = load(tmp_path, holdout=0)
    assert scene.format == "colmap" and len(scene.views) == 6


def test_a_model_that_names_none_of_the_photos_is_not_used_and_named(tmp_path):
    write_colmap(tmp_path / "old")
    (tmp_path / "old" / "images").rename(tmp_path / "elsewhere")
    for file in (tmp_path / "elsewhere").iterdir():
        file.rename(tmp_path / f"photo_{file.name}")
    (tmp_path / "elsewhere").rmdir()
    dataset = find_photos(tmp_path)
    assert dataset.notes == ("the COLMAP model in old/sparse/0 names none of these photos and is not used",)
    assert not model_fits(tmp_path, tmp_path / "old" / "sparse" / "0")


@pytest.mark.parametrize("place", ["sparse/0", "sparse"])
def test_a_model_without_cameras_is_named(tmp_path, place):
    write_colmap(tmp_path)
    (tmp_path / "sparse" / "0").rename(tmp_path / "model")
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    (tmp_path / "model" / "images.txt").rename(tmp_path / place / "images.txt")
    shutil.rmtree(tmp_path / "model")
    note = f"{place} is not read, because it has no cameras.bin or cameras.txt: cameras are found anew"
    assert find_photos(tmp_path).notes == (note,)


def test_a_model_without_its_photos_is_named(tmp_path):
    write_colmap(tmp_path)
    with pytest.raises(InputError, match="is a COLMAP model without photos; give the folder that holds it and images/"):
        load(tmp_path / "sparse" / "0")


def test_a_list_beside_the_model_states_the_held_out_photos(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "sparse" / "0" / "test.txt").write_text("004.png\r\n001.png\r\n\r\n")
    splits = {view.name: view.split for view in load(tmp_path).views}
    assert [name for name, split in splits.items() if split == "test"] == ["001", "004"] and len(splits) == 6
    assert {view.split for view in load(tmp_path, holdout=0).views} == {"train"}


def test_photos_of_a_kind_that_is_not_read_are_named_beside_a_model(tmp_path):
    write_colmap(tmp_path)
    for photo in (tmp_path / "images").iterdir():
        photo.rename(photo.with_suffix(".jxl"))
    with pytest.raises(
        InputError, match=r"none .* is here .*; files of kinds that are not read: 6 JXL \(000.jxl ...\)"
    ):
        load(tmp_path)


def test_photos_are_not_looked_for_behind_links_out_of_the_set(tmp_path):
    write_colmap(tmp_path / "set")
    images = tmp_path / "set" / "images"
    images.rename(tmp_path / "private")
    images.mkdir()
    (images / "a").symlink_to(tmp_path / "private")
    with pytest.raises(InputError, match="none of the model's 6 images is here"):
        read_colmap(tmp_path / "set")


@pytest.mark.parametrize("names, place", [("cam1/{:03d}.png", "."), ("{:03d}.png", "cam1")])
def test_photos_that_were_sorted_into_a_folder_or_out_of_it(tmp_path, names, place):
    """3DGS looks for file names alone, so its users' sets are without the folders of the model's names."""
    write_colmap(tmp_path, name=names)
    images = tmp_path / "images"
    (images / place).mkdir(exist_ok=True)
    (images / "masks").mkdir()
    for photo in sorted(images.rglob("*.png")):
        photo.rename(images / place / photo.name)
    dataset = read_colmap(tmp_path)
    assert [record.image for record in dataset.records] == [images / place / f"{i:03d}.png" for i in range(6)]
    model = tmp_path / "sparse" / "0" / "images.txt"
    model.write_text(model.read_text().replace("001.png", "other/000.png"))
    with pytest.raises(InputError, match="none of the model's 6 images is here"):
        read_colmap(tmp_path)  # Which of two photos of one name is there, nobody knows.


def test_photos_beside_undistorted_copies(tmp_path):
    """COLMAP's dense/ holds a model with its own images, gaussian-splatting issue 964 asks for them."""
    write_colmap(tmp_path)
    (tmp_path / "dense").mkdir()
    (tmp_path / "sparse" / "0").rename(tmp_path / "dense" / "sparse")
    (tmp_path / "images").rename(tmp_path / "dense" / "images")
    (tmp_path / "sparse").rmdir()
    write_photos(tmp_path / "images", [f"{i:03d}.png" for i in range(6)], (70, 52))
    view = load(tmp_path, holdout=0).views[0]
    assert view.source == tmp_path / "dense" / "images" / "000.png" and view.camera.width == 64


def test_undistorted_copies_count_where_no_photos_lie_beside_the_model(tmp_path):
    """COLMAP's automatic_reconstructor leaves sparse/0 and dense/0 in its workspace, and the photos elsewhere."""
    write_colmap(tmp_path)
    shutil.copytree(tmp_path / "sparse" / "0", tmp_path / "dense" / "0" / "sparse")
    (tmp_path / "images").rename(tmp_path / "dense" / "0" / "images")
    scene = load(tmp_path, holdout=0)
    assert scene.views[0].source == tmp_path / "dense" / "0" / "images" / "000.png" and len(scene.views) == 6
    assert "sparse/0 has no photos; cameras are those of dense/0/sparse, and photos lie beside it" in scene.notes


@pytest.mark.parametrize("copies", [False, True])
def test_what_3dgs_convert_leaves_before_it_undistorts(tmp_path, copies):
    """Its convert.py keeps photos in input/ and their model in distorted/; images/ and sparse/0 may not be there."""
    write_colmap(tmp_path, model="SIMPLE_RADIAL", params=(50.0, 32.0, 24.0, 0.1))
    (tmp_path / "images").rename(tmp_path / "input")
    (tmp_path / "distorted").mkdir()
    (tmp_path / "sparse").rename(tmp_path / "distorted" / "sparse")
    if copies:  # Undistorted, of another size: the model is not theirs.
        write_photos(tmp_path / "images", [f"{i:03d}.png" for i in range(6)], (58, 44))
    scene = load(tmp_path, holdout=0)
    assert scene.format == "colmap" and len(scene.points) == 5
    assert {view.source.parent.name for view in scene.views} == {"input"}


def test_undistorted_copies_of_3dgs_convert_are_used_if_they_are_whole(tmp_path):
    write_colmap(tmp_path)
    shutil.copytree(tmp_path / "sparse", tmp_path / "distorted" / "sparse")
    shutil.copytree(tmp_path / "images", tmp_path / "input")
    assert {view.source.parent.name for view in load(tmp_path, holdout=0).views} == {"images"}


def test_the_folder_of_photos_may_be_a_link(tmp_path):
    """Photos may lie on another disk; what the model names stays inside that folder."""
    write_colmap(tmp_path / "set")
    (tmp_path / "set" / "images").rename(tmp_path / "photos")
    (tmp_path / "set" / "images").symlink_to(tmp_path / "photos")
    assert len(load(tmp_path / "set").views) == 6
