"""Photos by the names that sets state: other suffixes, folders, cases and forms of accents."""

import os
import shutil

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.dataparser import ImageRecord
from sehdr_warp.scene.file_names import natural_key, safe_names, unique_names
from sehdr_warp.scene.lens import Lens
from tests.make_scenes import edited_json, load, said, write_blender, write_colmap


@pytest.mark.skipif(os.name == "nt", reason="names are bytes on POSIX alone")
@pytest.mark.parametrize("binary", [False, True])
def test_names_of_windows_and_in_latin_1(tmp_path, binary):
    write_colmap(tmp_path, 6, name="cam/{:03d}.png", binary=binary)
    path = tmp_path / "sparse" / "0" / f"images.{'bin' if binary else 'txt'}"
    content = path.read_bytes().replace(b"cam/000.png", b"cam\\000.png").replace(b"001.png", b"\xe901.png")
    path.write_bytes(content)
    images = os.fsencode(tmp_path / "images" / "cam")
    os.rename(images + b"/001.png", images + b"/\xe901.png")
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6 and not said(scene, "missing")
    os.rename(images + b"/\xe901.png", images + "/é01.png".encode())
    assert len(load(tmp_path, holdout=0).views) == 6


@pytest.mark.parametrize("suffix, stored", [(".PNG", ".png"), (".jpg", ".png"), (".jpg", ".exr")])
def test_photos_under_another_suffix_than_the_model_states(tmp_path, suffix, stored):
    """Conversion causes this, and so does structure from motion on JPEGs of an OpenEXR set."""
    import OpenEXR

    write_colmap(tmp_path)
    if stored == ".exr":
        for file in list((tmp_path / "images").iterdir()):
            planes = np.moveaxis(np.asarray(Image.open(file)).astype(np.float32) / 255, 2, 0).copy()
            file.unlink()
            channels = dict(zip("RGB", planes, strict=True))
            OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(file.with_suffix(".exr")))
    path = tmp_path / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace(".png", suffix))
    scene = load_scene(tmp_path, response="auto" if stored == ".exr" else "srgb", holdout=0)
    note = f"6 photos have another suffix than the set states: 000{suffix} is 000{stored}"
    assert len(scene.views) == 6 and said(scene, "another suffix") == [note] * (suffix != ".PNG")


@pytest.mark.parametrize("before", ["/home/other/sets/room/", "C:\\sets\\room\\", ""])
def test_absolute_names_of_a_copied_set(tmp_path, before):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for frame in values["frames"]:
            name = frame["file_path"].removeprefix("./")
            frame["file_path"] = (before or f"{tmp_path}/") + (name.replace("/", "\\") if "\\" in before else name)
    assert len(load(tmp_path, holdout=0).views) == 6
    files = sorted((tmp_path / "images").iterdir())
    files[0].unlink()
    assert len(load(tmp_path, holdout=0).views) == 5, "one photo that is missing stops no set"
    for file in files[1:]:
        file.unlink()
    with pytest.raises(InputError, match="image file not found, nor any of 6 frames; copy the whole set"):
        load(tmp_path)


def test_photos_that_are_listed_twice_count_once(tmp_path):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        values["frames"] += values["frames"][1:3]
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6
    assert said(scene, "more than once") == ["2 photos are listed more than once, and counted once: r_1.png, r_2.png"]


@pytest.mark.parametrize("stored", ["GRÖßE_{}.PNG", "Größe_{}.jpg"])
@pytest.mark.parametrize("folder", ["", "images/", "cam/"])
def test_case_and_forms_of_accents_do_not_matter(tmp_path, stored, folder):
    """Windows and macOS take such names for the same; a set may also name photos from the folder above."""
    write_colmap(tmp_path, name=("cam/" if folder == "cam/" else "") + "größe_{}.png")
    text = (tmp_path / "sparse" / "0" / "images.txt").read_text()
    if folder == "images/":
        (tmp_path / "sparse" / "0" / "images.txt").write_text(text.replace("größe", "images/größe"))
    place = tmp_path / "images" / ("cam" if folder == "cam/" else ".")
    for i in range(6):
        (place / f"größe_{i}.png").rename(place / stored.format(i))
    scene = load(tmp_path, holdout=0)
    assert [view.source.name for view in scene.views] == [stored.format(i) for i in range(6)]


def test_names_without_a_suffix_may_have_dots(tmp_path):
    """Metashape labels cameras like that."""
    write_colmap(tmp_path, name="frame.{:04d}.png")
    images = tmp_path / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(".png", ""))
    assert len(load(tmp_path, holdout=0).views) == 6


@pytest.mark.parametrize(
    "name", ["../images/r_{}.png", "../../data/set/images/r_{}.png", "../frames\\r_{}.png", "r_{}.png", "r_{}"]
)
def test_names_from_another_folder(tmp_path, name):
    """Relative to where a script ran, or without the folder."""
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            frame["file_path"] = name.format(i)
    assert len(load(tmp_path, holdout=0).views) == 6
    (tmp_path.parent / "r_0.png").write_bytes((tmp_path / "images" / "r_0.png").read_bytes())
    shutil.rmtree(tmp_path / "images")
    try:
        with pytest.raises(InputError, match="image file not found"):
            load(tmp_path)
    finally:
        (tmp_path.parent / "r_0.png").unlink()


def test_names_are_unique_and_test_views_keep_theirs(tmp_path):
    lens = Lens("SIMPLE_PINHOLE", 4, 4, (4, 2, 2), tmp_path)

    def shot(path, split):
        return ImageRecord((tmp_path / path).stem, tmp_path / path, lens, np.eye(4), split=split)

    shots = [shot("train/r_0.png", "train"), shot("train/R_1.png", "train"), shot("test/r_0.png", "test"),
             shot("a/x.png", None), shot("b/X.png", None), shot("train/r_2.png", "train")]  # fmt: skip
    assert unique_names(shots) == ["train_r_0", "R_1", "r_0", "a_x", "b_X", "r_2"]
    assert sorted(["img10", "img2", "a"], key=natural_key) == ["a", "img2", "img10"]


def test_names_are_safe_and_different():
    names = ["a/b", "..", "A_B", "a_b", "x" * 300, "con?", "a_b_2", ""]
    safe = safe_names(names)
    assert safe == ["a_b", "view", "A_B_3", "a_b_4", "x" * 120, "con_", "a_b_2", "view_2"]
    assert len({name.casefold() for name in safe}) == len(safe)
