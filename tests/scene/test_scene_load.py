"""What load_scene does with exposures, splits, names, bare photos, the embedded scene and unusable folders."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene.capture import Shot
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.names import natural_key, unique_names
from sehdr_warp.scene.sfm import reconstruct
from tests.make_scenes import load, pattern, write_blender, write_colmap

_TIME, _NUMBER, _ISO, _APEX = 33434, 33437, 34855, 37377


def test_exif_times_count_sensitivity_and_aperture(tmp_path):
    settings = [
        (1 / 100, 100, 4),
        (1 / 50, 100, 4),
        (1 / 100, 200, 4),
        (1 / 100, 100, 8),
        (1 / 200, 400, 4),
        (1, 100, 4),
    ]
    write_colmap(
        tmp_path,
        name="{:03d}.jpg",
        exif={i: {_TIME: t, _ISO: iso, _NUMBER: n} for i, (t, iso, n) in enumerate(settings)},
    )
    scene = load(tmp_path)
    light = [t * iso / 100 * (4 / n) ** 2 for t, iso, n in settings]
    np.testing.assert_allclose([view.exposure_time for view in scene.views], light, rtol=1e-5)
    assert scene.exposure_times_known
    text = " ".join(scene.notes)
    assert "ISO differs (100 to 400)" in text and "exposures differ: 0.0025 to 1 s" in text


def test_shutter_speed_stands_in_for_exposure_time(tmp_path):
    write_colmap(tmp_path, name="{:03d}.jpg", exif={i: {_APEX: 3.0} for i in range(6)})
    assert {view.exposure_time for view in load(tmp_path).views} == {0.125}


def test_one_photo_without_time_is_refused_and_a_list_helps(tmp_path):
    write_colmap(tmp_path, name="{:03d}.jpg", exif={i: {_TIME: 0.01} for i in range(5)})
    with pytest.raises(InputError, match=r"005.jpg: exposure time is absent in 1 of 6"):
        load(tmp_path)
    (tmp_path / "exposures.json").write_text(json.dumps({f"{i:03d}.jpg": 2.0 for i in range(6)}))
    assert {view.exposure_time for view in load(tmp_path).views} == {2.0}
    (tmp_path / "exposures.json").write_text(json.dumps([{"file": "000.jpg", "exposure_time": 0}]))
    with pytest.raises(InputError, match=r"exposures.json: exposure time of '000.jpg' is 0"):
        load(tmp_path)


def test_exif_time_of_zero_is_refused(tmp_path):
    write_colmap(tmp_path, name="{:03d}.jpg", exif={i: {_TIME: 0.0 if i == 2 else 0.01} for i in range(6)})
    with pytest.raises(InputError, match=r"002.jpg: EXIF exposure time is"):
        load(tmp_path)


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
        return Shot((tmp_path / path).stem, tmp_path / path, lens, np.eye(4), split=split)

    shots = [shot("train/r_0.png", "train"), shot("train/R_1.png", "train"), shot("test/r_0.png", "test"),
             shot("a/x.png", None), shot("b/X.png", None), shot("train/r_2.png", "train")]  # fmt: skip
    assert unique_names(shots) == ["train_r_0", "R_1", "r_0", "a_x", "b_X", "r_2"]
    assert sorted(["img10", "img2", "a"], key=natural_key) == ["a", "img2", "img10"]


@pytest.mark.parametrize("value, word", [(0, "100.0 %"), (255, "100.0 %")])
def test_all_black_or_white_is_refused(tmp_path, value, word):
    write_blender(tmp_path)
    for image in (tmp_path / "images").iterdir():
        Image.new("RGB", (40, 30), (value,) * 3).save(image)
    with pytest.raises(InputError, match=f"black or white in {word}"):
        load(tmp_path)
    (tmp_path / "transforms.json").unlink()
    with pytest.raises(InputError, match="all black or all white"):
        load(tmp_path)


def test_folders_that_cannot_be_used(tmp_path):
    def refused(folder, message):
        with pytest.raises(InputError, match=message) as caught:
            load(folder)
        assert "\n" not in str(caught.value)

    refused(tmp_path / "none", "not found")
    refused(tmp_path, "folder is empty")
    (tmp_path / "readme.md").write_text("x")
    refused(tmp_path, "no photos and no known layout")
    refused(tmp_path / "readme.md", "is not a folder")
    Image.fromarray(pattern(40, 30)).save(tmp_path / "one.png")
    refused(tmp_path, "only photo")
    write_colmap(tmp_path / "one", 1)
    refused(tmp_path / "one", "1 view, 1 for training; one view does not show depth")
    write_colmap(tmp_path / "gone")
    shutil.rmtree(tmp_path / "gone" / "images")
    refused(tmp_path / "gone", "images: folder not found")
    write_colmap(tmp_path / "other", name="x_{}.jpeg")
    shutil.rmtree(tmp_path / "other" / "images")
    shutil.copytree(tmp_path / "one" / "images", tmp_path / "other" / "images")
    refused(tmp_path / "other", "none of the model's 6 images is here")
    write_colmap(tmp_path / "half", binary=True)
    path = tmp_path / "half" / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:-5])
    refused(tmp_path / "half", "images.bin")


def test_photos_that_do_not_overlap_are_refused(tmp_path):
    for i in range(3):
        Image.fromarray(pattern(120, 90, i)).save(tmp_path / f"{i}.png")
    with pytest.raises(InputError, match="none of the 3 photos could be placed"):
        load(tmp_path)


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
    again = load(tmp_path, max_size=200, cache=tmp_path / "cache")
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
    model = reconstruct(sorted(tmp_path.glob("*.JPG")), tmp_path / "cache")
    assert sorted((lens.width, lens.height) for lens in model.cameras.values()) == [(567, 426), (708, 532)]


def test_embedded_scene_loads():
    scene = load("embedded")
    assert scene.format == "hdr-nerf" and scene.name == "embedded"
    assert len(scene.train_views) >= 10 and len(scene.test_views) >= 5 and len(scene.points) > 500
    assert all(view.hdr is not None and view.hdr.shape == view.image.shape for view in scene.views)
    assert scene.exposure_times_known


def test_the_room_is_light_and_transforms_need_no_pycolmap(tmp_path):
    """Also where lenses distort; triangulating points does need it."""
    write_blender(tmp_path, k1=-0.1)
    write_colmap(tmp_path / "colmap")
    heavy = "{'torch', 'warp', 'pycolmap', 'OpenEXR', 'scipy', 'matplotlib', 'colour'}"
    code = f"import sys, sehdr_warp.scene as s; print(sorted({heavy} & set(sys.modules)))\n"
    code += f"s.load_scene({str(tmp_path)!r}, response='srgb'); print('pycolmap' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "False"]
