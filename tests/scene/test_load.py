"""Load sets: splits, names, responses, the embedded scene and folders of photos."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name, selection
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.dataparser import ImageRecord
from sehdr_warp.scene.file_names import natural_key, unique_names
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.load import _held_out
from sehdr_warp.scene.readers.bare_photos import find_photos, inner_folder
from tests.make_scenes import load, pattern, write_blender, write_colmap, write_ply


def test_a_response_that_is_a_guess_is_noted(tmp_path):
    write_colmap(tmp_path, name="{:03d}.png")
    for path in (tmp_path / "images").iterdir():
        with Image.open(path) as photo:
            ramp = np.linspace(30, 220, photo.width).astype(np.uint8)
            Image.fromarray(np.broadcast_to(ramp[None, :, None], (photo.height, photo.width, 3)).copy()).save(path)
    notes = load_scene(tmp_path).notes
    assert sum("is a guess: curves that explain the photos as well differ" in note for note in notes) == 1
    assert not any("is a guess" in note for note in load_scene(tmp_path, response="srgb").notes)


def test_folders_far_below_count_if_none_is_near(tmp_path):
    for place in (tmp_path / "kitti/2011_09_26/drive_0001/image_02/data", tmp_path / "kitti/photos"):
        place.mkdir(parents=True)
        for i in range(4):
            Image.fromarray(pattern(16, 12, i)).save(place / f"{i}.jpg")
        assert inner_folder(tmp_path) == place


def test_a_folder_of_a_set_beside_the_photos_is_named(tmp_path):
    write_blender(tmp_path / "nerfstudio_data", 4)
    for place in (tmp_path / "images", tmp_path / "images_2"):
        place.mkdir()
        for i in range(4):
            Image.fromarray(pattern(16, 12, i)).save(place / f"{i}.jpg")
    assert find_photos(tmp_path).notes == ("photos in folders of it are not read: nerfstudio_data",)


def test_pictures_of_depth_and_normals_beside_photos_of_their_names_are_not_photos(tmp_path):
    """They may be colored."""
    kinds = ("{}_rgb.png", "{}_normal.png", "{}_depth.png")
    for seed, (kind, i) in enumerate((kind, i) for kind in kinds for i in range(4)):
        Image.fromarray(pattern(16, 12, seed)).save(tmp_path / kind.format(i))
    dataset = find_photos(tmp_path)
    assert [record.view for record in dataset.records] == [f"{i}_rgb" for i in range(4)]
    (note,) = dataset.notes
    assert note.startswith("8 pictures called depth, confidence or normals are left out: 0_depth.png, 0_normal.png")
    Image.fromarray(pattern(16, 12, 20)).save(tmp_path / "normal_lens.png")
    assert find_photos(tmp_path).records[-1].view == "normal_lens"


@pytest.mark.parametrize(
    ("cameras", "told"),
    [
        (
            ("NIKON D70\0\0", "PENTAX 67", "NIKON D70"),
            ["photos of 2 cameras get one response, which fits some of them better: NIKON D70 (2), PENTAX 67 (1)"],
        ),
        (("NIKON D70\0\0", "NIKON D70"), []),
    ],
)
def test_photos_of_several_cameras_are_told_of(tmp_path, cameras, told):
    write_colmap(tmp_path)
    for number, camera in enumerate(cameras):
        path, tags = tmp_path / "images" / f"{number:03d}.png", Image.Exif()
        tags[0x0110] = camera
        Image.fromarray(pattern(64, 48, number)).save(path, exif=tags)
    assert [note for note in load(tmp_path).notes if "cameras get" in note] == told


def test_layouts_without_a_protocol_hold_out_the_middle_of_each_block(tmp_path):
    write_blender(tmp_path, 13, ply_file_path="p.ply")
    write_ply(tmp_path / "p.ply", [(0, 0, 0)])
    scene = load(tmp_path)
    assert [view.name for view in scene.test_views] == ["r_4"], "not the last of the arc"
    assert "1 of 13 views is held out for testing: r_4" in scene.notes
    (tmp_path / "images" / "r_4.png").rename(tmp_path / "images" / "r 4 (2).png")
    content = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_text(content.replace("r_4", "r 4 (2)"))
    scene = load(tmp_path)
    named = scene.test_views[0].name  # As files, --at camera:NAME and summary.json have it.
    assert f"1 of 13 views is held out for testing: {named}" in scene.notes and " " not in named
    assert [view.name for view in load(tmp_path, holdout=4).test_views] == ["r_2", "r_6", "r_10"]
    for count, held in ((5, {2}), (6, {4}), (9, {4}), (16, {4, 12}), (4, set())):
        assert _held_out(count, None, None) == held
    assert _held_out(9, None, (8, 0)) == {0, 8} and _held_out(6, None, (2, 1)) == {1, 3, 5}
    assert not _held_out(20, 0, (8, 0))
    # Of a block whose middle view has an uncertain camera, the nearest other view is held out.
    assert _held_out(20, None, None, {3, 4, 5, 11}) == {2, 12}
    assert _held_out(8, None, None, set(range(7))) == {4} and _held_out(5, None, None, {2}) == {1}
    assert _held_out(13, 5, None, {6, 7, 8}) == {2, 5}


def test_the_response_is_chosen_from_codes_as_photographed(monkeypatch):
    """At any size the same photos are judged; what chose is noted, and another curve develops otherwise."""
    judged = []

    def select(photos, candidates, **options):
        judged.append([photo.shape for photo in photos])
        return SimpleNamespace(response=response_by_name("camera"), uncertainty=0.0, note=None)

    monkeypatch.setattr(selection, "select_response", select)
    scenes = [load_scene("embedded", max_size=size, candidates=("srgb", "camera")) for size in (None, 40)]
    assert judged == [[(160, 160, 3)] * 18] * 2
    assert all(scene.response.name == "camera" for scene in scenes)
    assert scenes[0].chosen_by == ("posterior", ("srgb", "camera"))
    assert scenes[0].views[0].codes.dtype == np.uint8 and scenes[1].views[0].codes.dtype == np.uint16
    named = load_scene("embedded", max_size=40, response="hdr-nerf")
    assert named.chosen_by is None and named.response.name == "hdr-nerf"
    assert np.abs(named.views[0].image - scenes[1].views[0].image).max() > 1e-3
    assert load_scene("embedded", max_size=40, response=named.response).response is named.response


def test_the_package_and_the_room_are_light():
    """Without poses to check and lenses that distort, nothing of structure from motion is needed."""
    heavy = "{'torch', 'warp', 'pycolmap', 'OpenEXR', 'scipy', 'matplotlib', 'colour'}"
    code = f"import sys, sehdr_warp.scene as s; print(sorted({heavy} & set(sys.modules)))\n"
    code += "s.load_scene('embedded', max_size=16, response='srgb'); print('pycolmap' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "False"]


def test_photos_are_averaged_side_by_side(tmp_path):
    """In a new process, whose kernels are not loaded yet: eight threads that load one at once end it."""
    write_colmap(tmp_path, count=16)
    code = f"from sehdr_warp.scene import load_scene; load_scene({str(tmp_path)!r}, max_size=24, response='hdr-nerf')"
    environment = os.environ | {"SEHDR_THREADS": "8"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=120)


def test_photos_are_found_beside_a_cover_and_told_of_in_folders(tmp_path):
    for name in ("day/1.png", "day/2.png", "day/3.png", "text/note.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="day/1.png"):  # It is empty, and found all the same.
        load(tmp_path)
    (tmp_path / "day").rename(tmp_path / "images")
    (tmp_path / "cover.jpg").touch()
    with pytest.raises(InputError, match="images/1.png"):
        load(tmp_path)


def test_scenes_views_and_cameras_print_in_one_line():
    scene = load_scene("embedded", max_size=32)
    view = scene.views[0]
    assert repr(scene) == "Scene('embedded', hdr-nerf, 27 views of 32 x 32, 18 to train)"
    assert repr(view) == "View('train_r_0', 32 x 32, train, 0.5 s)"
    assert repr(view.camera).startswith("Camera(32 x 32, focal length 32.8") and "\n" not in repr(view.camera)


def test_splits(tmp_path):
    write_colmap(tmp_path, 9)
    assert [view.name for view in load(tmp_path).test_views] == ["000", "008"]
    assert [view.name for view in load(tmp_path, holdout=4).test_views] == ["000", "004", "008"]
    assert not load(tmp_path, holdout=0).test_views
    with pytest.raises(InputError, match=r"9 views, 0 for training.*holdout 8, or 0 for none"):
        load(tmp_path, holdout=1)
    write_colmap(tmp_path / "few", 4)
    few = load(tmp_path / "few")
    assert not few.test_views and "no views are held out for testing" in few.notes


def test_names_are_unique_and_test_views_keep_theirs(tmp_path):
    lens = Lens("SIMPLE_PINHOLE", 4, 4, (4, 2, 2), tmp_path)

    def shot(path, split):
        return ImageRecord((tmp_path / path).stem, tmp_path / path, lens, np.eye(4), split=split)

    shots = [shot("train/r_0.png", "train"), shot("train/R_1.png", "train"), shot("test/r_0.png", "test"),
             shot("a/x.png", None), shot("b/X.png", None), shot("train/r_2.png", "train")]  # fmt: skip
    assert unique_names(shots) == ["train_r_0", "R_1", "r_0", "a_x", "b_X", "r_2"]
    assert sorted(["img10", "img2", "a"], key=natural_key) == ["a", "img2", "img10"]
