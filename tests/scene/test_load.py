"""What load_scene does with exposures, splits, names, bare photos, the embedded scene and unusable folders."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name, selection
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.color.primaries import linear_to_srgb, srgb_to_linear
from sehdr_warp.scene.dataparser import ImageRecord, PointCloud
from sehdr_warp.scene.exposure.times import shutter
from sehdr_warp.scene.file_names import natural_key, unique_names
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.load import _held_out
from sehdr_warp.scene.photos import brightened_codes
from sehdr_warp.scene.readers import bare_photos
from sehdr_warp.scene.readers.colmap_model import ModelImage, SparseModel
from sehdr_warp.scene.sfm import reconstruction as sfm
from sehdr_warp.scene.sfm.reconstruction import MOST_ERROR, Reconstruction, image_name, reconstruct
from tests.make_scenes import arc_poses, edited_json, load, write_blender, write_colmap, write_ply

_TIME, _NUMBER, _ISO, _APEX = 33434, 33437, 34855, 37377

LOST = image_name(2)


def test_exif_times_count_sensitivity_and_aperture(tmp_path):
    settings = [(0.01, 100, 4), (0.02, 100, 4), (0.01, 200, 4), (0.01, 100, 8), (0.005, 400, 4), (1, 100, 4)]
    exif = {i: {_TIME: t, _ISO: iso, _NUMBER: n} for i, (t, iso, n) in enumerate(settings)}
    write_colmap(tmp_path, name="{:03d}.jpg", exif=exif)
    scene = load(tmp_path)
    light = [t * iso / 100 * (4 / n) ** 2 for t, iso, n in settings]
    np.testing.assert_allclose([view.exposure_time for view in scene.views], light, rtol=1e-5)
    assert scene.exposure_times_known
    text = " ".join(scene.notes)
    assert "ISO differs (100 to 400)" in text and "exposures differ: 1/400 to 1 s" in text


def test_exposures_of_photos_that_are_left_out_are_not_told_of(tmp_path, monkeypatch):
    exif = {i: {_TIME: 0.01, _ISO: 100} for i in range(5)} | {5: {_TIME: 1.0, _ISO: 400}}
    write_colmap(tmp_path / "model", name="{:03d}.jpg", exif=exif)
    placed = load(tmp_path / "model")
    assert "exposures differ: 1/100 to 4 s" in " ".join(placed.notes)
    photos = shutil.copytree(tmp_path / "model" / "images", tmp_path / "bare")

    def place_all_but_the_last(dataset, _):
        camera = placed.views[0].camera
        lens = Lens("PINHOLE", camera.width, camera.height, tuple(camera.intrinsics), photos)
        records = (replace(r, lens=lens, world_to_camera=np.eye(4)) for r in dataset.records if r.view != "005")
        return replace(dataset, records=tuple(records)), ["005.jpg"]

    monkeypatch.setattr("sehdr_warp.scene.load.place_photos", place_all_but_the_last)
    notes = " ".join(load(photos).notes)
    assert "exposures differ" not in notes and "ISO" not in notes
    damaged = tmp_path / "model" / "images" / "005.jpg"
    damaged.write_bytes(damaged.read_bytes()[:-600])
    notes = " ".join(load(tmp_path / "model").notes)
    assert "1 of 6 photos cannot be used" in notes and "exposures differ" not in notes


def test_a_response_that_is_a_guess_is_noted(tmp_path):
    write_colmap(tmp_path, name="{:03d}.png")
    for path in (tmp_path / "images").iterdir():
        with Image.open(path) as photo:
            ramp = np.linspace(30, 220, photo.width).astype(np.uint8)
            Image.fromarray(np.broadcast_to(ramp[None, :, None], (photo.height, photo.width, 3)).copy()).save(path)
    notes = load_scene(tmp_path).notes
    assert sum("is a guess: curves that explain the photos as well differ" in note for note in notes) == 1
    assert not any("is a guess" in note for note in load_scene(tmp_path, response="srgb").notes)


@pytest.mark.parametrize(
    "seconds, text",
    [(1 / 640, "1/640 s"), (0.000634115, "1/1577 s"), (0.125, "1/8 s"), (0.28, "0.28 s"), (0.4, "0.4 s"), (8, "8 s")],
)
def test_times_read_as_photographers_write_them(seconds, text):
    assert shutter(seconds) == text


def test_one_photo_without_time_does_not_stop_a_set_and_a_list_helps(tmp_path):
    write_colmap(tmp_path, name="{:03d}.jpg", exif={i: {_TIME: 0.01} for i in range(5)})
    assert any(note.startswith("005 does not state its exposure: ") for note in load(tmp_path).notes)
    (tmp_path / "exposures.json").write_text(json.dumps({"005.jpg": 0.02}))
    assert [view.exposure_time for view in load(tmp_path).views] == [0.01] * 5 + [0.02]
    (tmp_path / "exposures.json").write_text(json.dumps({f"{i:03d}.jpg": 2.0 for i in range(6)}))
    assert {view.exposure_time for view in load(tmp_path).views} == {2.0}
    (tmp_path / "exposures.json").write_text(json.dumps({f"{i:03d}.jpg": "1/125" for i in range(6)}))
    assert {view.exposure_time for view in load(tmp_path).views} == {0.008}
    for wrong in (0, "1/0", "1/60 x", "/2", True, None, [1]):
        (tmp_path / "exposures.json").write_text(json.dumps([{"file": "000.jpg", "exposure_time": wrong}]))
        with pytest.raises(InputError, match=rf"time of .000.jpg. is {re.escape(repr(wrong))}"):
            load(tmp_path)


def test_listed_times_of_no_photo_are_named(tmp_path):
    write_colmap(tmp_path, name="{:03d}.jpg")
    times, table = {f"{i:03d}.jpg": 0.01 for i in range(6)}, tmp_path / "exposures.json"
    table.write_text(json.dumps(times))
    assert not [note for note in load(tmp_path).notes if "exposures.json" in note]
    table.write_text(json.dumps(times | {"000.JPG.bak": 0.01}))
    assert "exposures.json: 1 of its 7 names belong to no photo: 000.JPG.bak" in load(tmp_path).notes
    table.write_text(json.dumps({name.replace("5.jpg", "5x.jpg"): time for name, time in times.items()}))
    notes = load(tmp_path).notes
    assert "exposures.json: 1 of its 6 names belong to no photo: 005x.jpg" in notes
    assert any(note.startswith("005 does not state its exposure: ") for note in notes)
    table.write_text(json.dumps({f"shot{i}.jpg": 0.01 for i in range(6)}))
    assert [note for note in load(tmp_path).notes if "6 of its 6 names" in note and "shot2.jpg ..." in note]


@pytest.mark.parametrize("name", ["exposures.csv", "Exposures.json", "exposure_times.txt"])
def test_lists_of_times_that_are_not_read_are_named(tmp_path, name):
    write_blender(tmp_path)
    (tmp_path / name).write_text("{}")
    note = f'{name} is not read: write exposures.json, {{"file name": seconds, ...}}'
    assert note in load(tmp_path).notes


def test_one_frame_with_an_impossible_time_stops_no_set(tmp_path):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            frame["exposure_time"] = 0.5 if i else -1
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6 and scene.views[1].exposure_time == 0.5
    assert "1 of 6 frames state no usable exposure time: exposure time of './images/r_0' is -1" in scene.notes
    for frame in values["frames"]:
        frame["exposure_time"] = -1
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    with pytest.raises(InputError, match="exposure time of './images/r_0' is -1; state seconds above zero"):
        load(tmp_path)


@pytest.mark.parametrize(
    "name",
    ["{}.JPG", "{}.CR2", "images/{}", "C:\\scan\\images\\{}.jpg", "/home/me/scan/images/{}.jpg", "./IMAGES/{}.jpg"],
)
def test_listed_times_under_other_spellings(tmp_path, name):
    """Another case, the suffix of another kind of photo, or a path of the machine that wrote the list."""
    write_colmap(tmp_path, name="img_{}.jpg")
    times = {name.format(f"img_{i}"): 0.01 * 2**i for i in range(6)}
    (tmp_path / "exposures.json").write_text(json.dumps(times))
    scene = load(tmp_path, holdout=0)
    assert [view.exposure_time for view in scene.views] == pytest.approx(list(times.values()))
    assert not [note for note in scene.notes if "exposures.json" in note]


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


def test_bare_photos_are_placed_undistorted_and_cached(tmp_path, shared, caplog):
    """Five of the castle's photos at a fifth of their size: all placed, EXIF times kept, the second call reuses."""
    photos = sorted((shared / "data" / "castle").glob("*.JPG"))[3:8]
    for photo in photos:
        with Image.open(photo) as image:
            image.reduce(4).save(tmp_path / photo.name, exif=image.getexif(), quality=95)
    caplog.set_level("INFO", "sehdr_warp.scene")
    scene = load(tmp_path, max_size=200, cache=tmp_path / "cache")
    assert scene.format == "photos" and len(scene.views) == 5 and len(scene.points) > 200
    assert len({view.exposure_time for view in scene.views}) > 1 and scene.exposure_times_known
    assert max(view.image.shape[1] for view in scene.views) == 200 and scene.views[0].camera.width == 200
    # Every point lies before the cameras, and most of it inside the pictures that show it.
    for view in scene.views:
        x, y, z = view.camera.world_to_camera[:3, :3] @ scene.points.T + view.camera.world_to_camera[:3, 3:]
        column = view.camera.fx * x / z + view.camera.cx
        row = view.camera.fy * y / z + view.camera.cy
        inside = (z > 0) & (column > 0) & (column < view.camera.width) & (row > 0) & (row < view.camera.height)
        assert inside.mean() > 0.4
        colors = view.image[row[inside].astype(int), column[inside].astype(int)]
        assert np.corrcoef(colors.ravel(), scene.point_colors[inside].ravel())[0, 1] > 0.5
    caplog.clear()
    (tmp_path / "moved").mkdir()
    for photo in tmp_path.glob("*.JPG"):
        shutil.copy(photo, tmp_path / "moved")
    again = load(tmp_path / "moved", max_size=100, cache=tmp_path / "cache")
    assert "cached" in caplog.messages[0]
    np.testing.assert_array_equal(again.points, scene.points)
    assert not [entry for entry in (tmp_path / "cache").iterdir() if entry.name.startswith("sehdr-sfm-")]


def test_turned_photos_are_placed_upright(tmp_path, shared):
    """Photos stored on their side with an EXIF orientation give the scene of the upright ones."""
    for photo in sorted((shared / "data" / "castle").glob("*.JPG"))[4:8]:
        with Image.open(photo) as image:
            upright = image.reduce(6)
        exif = Image.Exif()
        exif[0x0112] = 6
        for folder, picture, tags in (("up", upright, Image.Exif()), ("side", upright.rotate(90, expand=True), exif)):
            (tmp_path / folder).mkdir(exist_ok=True)
            picture.save(tmp_path / folder / f"{photo.stem}.png", exif=tags)
    up, side = (load(tmp_path / folder, max_size=100) for folder in ("up", "side"))
    assert len(up.views) == len(side.views) == 4
    for a, b in zip(up.views, side.views, strict=True):
        assert a.image.shape == b.image.shape
        assert np.abs(a.image - b.image).mean() < 0.01


def test_photos_of_several_cameras_get_their_own_lenses(tmp_path, shared):
    photos = sorted((shared / "data" / "castle").glob("*.JPG"))[4:8]
    for i, photo in enumerate(photos):
        with Image.open(photo) as image:
            image.reduce(4 if i < 3 else 5).save(tmp_path / photo.name, quality=95)
    reconstruction = reconstruct(sorted(tmp_path.glob("*.JPG")), tmp_path / "cache")
    assert {(image.lens.width, image.lens.height) for image in reconstruction.model.images} == {(567, 426), (708, 532)}
    assert 0 < reconstruction.error < MOST_ERROR and not reconstruction.notes(photos)


def test_dark_photos_are_placed_by_brightened_codes(tmp_path, shared):
    for photo in sorted((shared / "data" / "castle").glob("*.JPG"))[4:8]:
        with Image.open(photo) as image:
            light = srgb_to_linear(np.asarray(image.reduce(6)) / 255) / 32
        Image.fromarray(np.rint(255 * linear_to_srgb(light)).astype(np.uint8)).save(tmp_path / f"{photo.stem}.png")
    reconstruction = reconstruct(sorted(tmp_path.glob("*.png")), tmp_path / "cache")
    assert len(reconstruction.model.images) == 4 and not reconstruction.weak
    assert len(reconstruction.model.cloud.positions) > 300  # 83 without


def test_codes_of_bright_photos_stay_and_those_of_dark_ones_reach_a_midtone():
    bright = np.full((16, 16, 3), 100, np.uint8)
    assert brightened_codes(bright) is bright
    np.testing.assert_array_equal(brightened_codes(bright.astype(np.uint16) * 257), bright)
    assert abs(int(brightened_codes(np.full((16, 16, 3), 5000, np.uint16)).mean()) - 0.3 * 255) < 1
    assert not brightened_codes(np.zeros((16, 16, 3), np.uint8)).any()
    bright[:, 4:] = 1  # A black background with noise
    assert brightened_codes(bright) is bright


def test_an_object_that_turns_is_placed_by_its_masks(tmp_path, shared):
    known = {view.name: view.camera for view in load(shared / "data" / "tankard_turntable", max_size=100).views}
    for kind, suffix in (("images", "jpg"), ("masks", "png")):
        (tmp_path / kind).mkdir()
        for index in range(9669, 9677):
            shutil.copy(shared / "data" / "tankard_turntable" / kind / f"IMG_{index}.{suffix}", tmp_path / kind)
    views = load(tmp_path, max_size=100).views
    turns = [(view.camera.world_to_camera[:3, :3], known[view.name].world_to_camera[:3, :3]) for view in views]
    assert len(views) >= 6
    for (a, true_a), (b, true_b) in pairwise(turns):
        difference = (b @ a.T) @ (true_b @ true_a.T).T
        assert np.degrees(np.arccos(np.clip((np.trace(difference) - 1) / 2, -1, 1))) < 1


def test_masks_that_keep_too_little_are_not_used_for_placing(tmp_path, shared, caplog):
    (tmp_path / "masks").mkdir()
    for photo in sorted((shared / "data" / "castle").glob("*.JPG"))[4:8]:
        with Image.open(photo) as image:
            image.reduce(6).save(tmp_path / photo.name, quality=95)
            mask = Image.new("L", image.reduce(6).size)
        mask.paste(255, (0, 0, 60, 60))
        mask.save(tmp_path / "masks" / f"{photo.stem}.png")
    assert len(load(tmp_path, max_size=100).views) == 4
    assert "masks leave too little to place half of the photos" in caplog.text


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
    assert len(bare_photos._reconstruct(files, None, files).model.images) == expected
    assert ("and cameras agree" in caplog.text) == (expected == 6)


def test_masks_count_if_whole_photos_place_no_more_than_they(monkeypatch, caplog):
    lens = Lens("PINHOLE", 8, 6, (7.0, 7.0, 4.0, 3.0), Path("cameras.bin"))
    images = tuple(ModelImage(image_name(i), lens, np.eye(4)) for i in range(4))
    cloud = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    found = {masked: Reconstruction(SparseModel(images, cloud), 0.5, ()) for masked in (True, False)}
    monkeypatch.setattr(bare_photos, "reconstruct", lambda photos, cache, masks=(): found[bool(masks)])
    files = [Path(f"{i}.jpg") for i in range(12)]
    assert bare_photos._reconstruct(files, None, files) is found[True] and not caplog.text


def test_many_photos_are_placed_by_their_likely_pairs(tmp_path, shared, monkeypatch, caplog):
    """And a photo that none is likely for is matched with all others before the second try."""
    monkeypatch.setattr(sfm, "EXHAUSTIVE_LIMIT", 3)
    photos = sorted((shared / "data" / "castle").glob("*.JPG"))[3:8]
    for photo in photos:
        with Image.open(photo) as image:
            image.reduce(4).save(tmp_path / photo.name, quality=95)
    photos = sorted(tmp_path.glob("*.JPG"))
    caplog.set_level("INFO", "sehdr_warp.scene")
    assert len(reconstruct(photos, tmp_path / "cache").model.images) == 5
    assert "comparing photos: 5" in caplog.messages
    likely = sfm.likely_pairs
    monkeypatch.setattr(sfm, "likely_pairs", lambda database: [pair for pair in likely(database) if LOST not in pair])
    again = reconstruct(photos, tmp_path / "again")
    assert "matching pairs of photos that could not be placed: 4" in caplog.messages
    assert LOST in {image.name for image in again.model.images} and len(again.model.images) == 5


def test_poor_placement_is_named_with_its_photos():
    photos = [Path(f"{index}.jpg") for index in range(8)]
    lens = Lens("PINHOLE", 8, 6, (7.0, 7.0, 4.0, 3.0), Path("cameras.bin"))
    images = tuple(ModelImage(f"{index:05d}.png", lens, np.eye(4)) for index in (0, 1, 2, 3, 4, 6))
    model = SparseModel(images, PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32)))
    lost, weak, error = Reconstruction(model, 1.4, (2, 4)).notes(photos)
    assert lost == (
        "2 of 8 photos could not be placed and were left out: 5.jpg, 7.jpg; photos between these and the others help"
    )
    assert weak.startswith("2 photos share few points with others, so their places are uncertain: 2.jpg, 4.jpg;")
    assert "1.4 pixels" in error
    lost, _ = Reconstruction(SparseModel(images[:1], model.cloud), 0.5, (0,)).notes(photos)
    assert "7 of 8 photos could not be placed and were left out: 1.jpg to 7.jpg;" in lost
    _, weak, _ = Reconstruction(model, 1.4, (3,)).notes(photos)
    assert weak.startswith("1 photo shares few points with others, so its place is uncertain: 3.jpg;")


def test_the_room_is_light_and_transforms_need_no_pycolmap(tmp_path):
    """Unless lenses distort."""
    write_blender(tmp_path)
    write_colmap(tmp_path / "colmap")
    heavy = "{'torch', 'warp', 'pycolmap', 'OpenEXR', 'scipy', 'matplotlib', 'colour'}"
    code = f"import sys, sehdr_warp.scene as s; print(sorted({heavy} & set(sys.modules)))\n"
    code += f"s.load_scene({str(tmp_path)!r}, response='srgb'); print('pycolmap' in sys.modules)"
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
