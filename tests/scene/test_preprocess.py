"""Views from photos: averages, undistortion, transparency."""

import json
import os
import subprocess
import sys
import threading
import time

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from sehdr_warp.scene import preprocess
from sehdr_warp.synth.expose import write_radiance
from tests.make_scenes import edit_transforms, edited_json, load, pattern, write_blender, write_colmap


def test_photos_are_averaged_side_by_side(tmp_path):
    """Run a new process, whose kernels are not loaded yet: eight threads that load one at once end it."""
    write_colmap(tmp_path, count=16)
    code = f"from sehdr_warp.scene import load_scene; load_scene({str(tmp_path)!r}, max_size=24, response='hdr-nerf')"
    environment = os.environ | {"SEHDR_THREADS": "8"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=120)


@pytest.mark.parametrize("folder", [None, "hdr", "images"])
def test_openexr_pictures_are_read_one_at_a_time(tmp_path, monkeypatch, folder):
    """The output of their reader is suppressed for the whole process, so only one runs: for truth and for photos."""
    write_colmap(tmp_path)
    for photo in sorted((tmp_path / "images").iterdir())[: {None: 0, "hdr": 1}.get(folder)]:
        (tmp_path / folder).mkdir(exist_ok=True)
        write_radiance(tmp_path / folder / f"{photo.stem}.exr", np.full((48, 64, 3), 0.5, np.float32))
        if folder == "images":
            photo.unlink()
    reading, most, lock, view = 0, [0], threading.Lock(), preprocess._Preprocessor.view

    def slow(*job):
        nonlocal reading
        with lock:
            reading += 1
            most.append(reading)
        time.sleep(0.05)
        with lock:
            reading -= 1
        return view(*job)

    monkeypatch.setattr(preprocess._Preprocessor, "view", slow)
    monkeypatch.setenv("SEHDR_THREADS", "4")
    load(tmp_path, response="auto" if folder == "images" else "srgb")
    assert (max(most) > 1) is (folder is None)


def test_a_lens_that_leaves_little_of_the_photos_is_named(tmp_path):
    write_blender(tmp_path, 6, size=(150, 200), fl_x=343.0, fl_y=975.0, k1=46.6, k2=-3690.0)
    note = "lens: undistorted, 6 of 6 photos show at most "
    assert any(line.startswith(note) for line in load(tmp_path).notes)
    edit_transforms(tmp_path, k1=-0.3, k2=0.1)
    assert not any(line.startswith(note) for line in load(tmp_path).notes)


def test_transparent_pixels_show_black_light(tmp_path):
    write_blender(tmp_path, rgba=True, camera_angle_x=0.7)
    scene = load(tmp_path, cache=tmp_path / "cache")
    view = scene.views[0]
    assert view.image[:, :20].max() == 0 and view.mask is None and scene.black_background
    note = "transparency: 6 of 6 photos have transparent pixels, which count as black light"
    assert note in load(tmp_path, cache=tmp_path / "cache").notes
    np.testing.assert_allclose(view.image[:, 20:], pattern(40, 30, 0)[:, 20:] / 255, atol=1e-6)


@pytest.mark.parametrize("derived", [False, True])
@pytest.mark.parametrize("alpha", [None, 1.0, 0.0])
def test_transparent_pixels_of_openexr_pictures_show_black_light(tmp_path, derived, alpha):
    """Pictures are photos here, or truth that photos are computed from."""
    write_blender(tmp_path, camera_angle_x=0.7)
    light = np.random.default_rng(0).uniform(0.1, 1, (30, 40, 4)).astype(np.float32)
    light[..., 3] = 1
    light[:, :20, :3], light[:, :20, 3] = (0, 0.0 if alpha is None else alpha)
    channels = {"RGB": light[..., :3].copy()} if alpha is None else {"RGBA": light}
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            place = f"train_hdr/hdr_{i:03d}.exr" if derived else f"images/r_{i}.exr"
            (tmp_path / place).parent.mkdir(exist_ok=True)
            with OpenEXR.File({}, channels) as file:
                file.write(str(tmp_path / place))
            (tmp_path / "images" / f"r_{i}.png").unlink()
            frame["file_path"] = f"train/r_{i}" if derived else place
    if derived:
        edit_transforms(tmp_path, photo_response="reinhard-gamma")
        (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
        (tmp_path / "exposure_train.json").write_text(json.dumps({f"train/r_{i}_0.png": 1.0 for i in range(6)}))
    scene = load(tmp_path, response="auto")
    assert scene.black_background is (alpha == 0)
    note = "transparency: 6 of 6 photos have transparent pixels, which count as black light"
    assert (note in scene.notes) is (alpha == 0)
    assert all(view.mask is None and view.image[:, :20].max() == 0 < view.image[:, 20:].min() for view in scene.views)


def test_alpha_keeps_pixels_out(tmp_path):
    write_colmap(tmp_path)
    alpha = np.full((48, 64, 1), 255, np.uint8)
    alpha[:12] = 0
    Image.fromarray(np.concatenate([pattern(64, 48, 1), alpha], 2)).save(tmp_path / "images" / "001.png")
    scene = load(tmp_path)
    assert scene.views[1].mask[:12].max() == 0 and scene.views[1].mask[12:].min() == 1
    np.testing.assert_array_equal(scene.views[1].image, pattern(64, 48, 1).astype(np.float32) / np.float32(255))
    assert scene.views[2].mask is None and not scene.black_background
    assert "transparency: 1 of 6 photos have transparent pixels, which are left out" in scene.notes


@pytest.mark.parametrize(
    ("suffix", "options", "rounds"),
    [
        ("jpg", {"quality": 92}, True),
        ("png", {"quality": 92, "format": "JPEG"}, True),
        ("avif", {"quality": 92}, True),
        ("webp", {"quality": 92}, True),
        ("webp", {"quality": 75}, True),
        ("webp", {"quality": 92, "exif": Image.Exif().tobytes(), "icc_profile": b"odd"}, True),
        ("webp", {"lossless": True, "quality": 92, "exif": Image.Exif().tobytes()}, False),
        ("webp", {"lossless": True}, False),
        ("png", {}, False),
    ],
)
@pytest.mark.parametrize(("red", "clips"), [(3.0, True), (0.95, False)])
def test_values_that_rounded_colors_make_darker_amid_clipped_ones_are_clipped(
    tmp_path, suffix, options, rounds, red, clips
):
    """A lamp whose red clips: its noisy other colors, coarsely rounded, leave a third of the red at 250 to 254."""
    write_colmap(tmp_path, size=(128, 96), name=f"{{:03d}}.{suffix}")
    for seed, photo in enumerate(sorted((tmp_path / "images").iterdir())):
        light = np.where(np.arange(128)[:, None] < 64, [red, 0.35, 0.1], 0.02) * np.ones((96, 1, 1))
        light += 0.03 * np.sqrt(light) * np.random.default_rng(seed).normal(size=light.shape)
        codes = np.rint(255 * light.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
        Image.fromarray(codes).save(photo, **options)
        stored = np.asarray(Image.open(photo))
    codes = load(tmp_path).views[-1].codes
    white = (codes[8:-8, 8:56, 0] == 255).mean()
    assert white > 0.97 if clips else white < 0.1
    assert np.array_equal(codes[..., 1:], stored[..., 1:])
    assert (rounds and clips) != np.array_equal(codes, stored)
