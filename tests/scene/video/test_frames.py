"""Choosing the frames of a clip that become photos, and storing them."""

import logging
import shutil
import subprocess

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.color.encoding import encoding_of
from sehdr_warp.scene.color.primaries import srgb_to_linear
from sehdr_warp.scene.file_names import list_images
from sehdr_warp.scene.images.ldr_files import open_image, read_ldr
from sehdr_warp.scene.video.decode import open_clip
from sehdr_warp.scene.video.frames import choose_frames, frames_folder

from .clips import pan, write_clip


def test_the_sharpest_frame_of_each_interval_of_movement(tmp_path):
    blur = {i for i in range(60) if i % 3}
    write_clip(tmp_path / "a.mp4", pan(60, blur=blur), codec="libx264", pixels="yuv420p")
    choice = choose_frames(open_clip(tmp_path / "a.mp4"))
    # 59 steps of 4 of 128 pixels are 1.84 widths.
    assert choice.total == 60 and choice.movement == pytest.approx(59 * 4 / 128, rel=0.05)
    assert 20 <= len(choice.numbers) <= 24
    assert np.mean([number % 3 == 0 for number in choice.numbers]) > 0.8


def test_a_resting_camera_gives_no_frames(tmp_path):
    frames = list(pan(30))
    write_clip(tmp_path / "a.mp4", frames[:15] + [frames[15]] * 60 + frames[15:], codec="libx264", pixels="yuv420p")
    choice = choose_frames(open_clip(tmp_path / "a.mp4"))
    assert sum(17 <= number <= 73 for number in choice.numbers) <= 2


def test_frames_are_kept_in_the_cache(tmp_path, caplog):
    write_clip(tmp_path / "a.mp4", pan(30), tags=(18, 9, 9))
    clip = open_clip(tmp_path / "a.mp4")
    folder = frames_folder(clip, tmp_path / "cache")
    files = list_images(folder, (".png",))
    assert len(files) == 24 and read_ldr(files[0]).pixels.dtype == np.uint16
    with caplog.at_level(logging.INFO, "sehdr_warp.scene"):
        assert frames_folder(clip, tmp_path / "cache") == folder
    assert "using the cached result" in caplog.text
    files[0].write_bytes(b"")
    assert frames_folder(clip, tmp_path / "cache") == folder and files[0].stat().st_size > 0


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs FFmpeg's program")
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("tags", [
    (1, 1, 1), (13, 1, 1), (6, 6, 6), (5, 5, 5), (4, 1, 1), (7, 7, 7), (14, 9, 9), (11, 1, 1), (2, 2, 2),
], ids=["709", "sRGB", "601", "gamma 2.8", "gamma 2.2", "240M", "2020", "xvYCC", "nothing"])  # fmt: skip
def test_a_clip_and_frames_that_ffmpeg_makes_of_it_have_the_same_light(tmp_path, tags, full):
    """FFmpeg states a clip's curve and primaries in its PNG files: gAMA and cHRM, and in newer versions cICP."""
    write_clip(tmp_path / "a.mp4", pan(24), tags=tags, codec="libx264", pixels="yuv444p", full=full)
    pattern = tmp_path / "frame_%06d.png"
    subprocess.run(["ffmpeg", "-v", "error", "-i", tmp_path / "a.mp4", "-start_number", "0", pattern], check=True)
    clip = open_clip(tmp_path / "a.mp4")
    to_rec709 = clip.color.to_rec709()
    for file in list_images(frames_folder(clip, tmp_path / "cache"), (".png",))[:3]:
        with open_image(tmp_path / file.name) as image:
            encoding = encoding_of(image)
        frame = read_ldr(tmp_path / file.name).pixels
        frame_light = srgb_to_linear(frame / 255) if encoding is None else encoding.to_linear(frame)[0]
        photo = read_ldr(file)
        light = srgb_to_linear(photo.pixels / photo.levels) @ (np.eye(3) if to_rec709 is None else to_rec709).T
        assert np.abs(np.log2(frame_light.mean((0, 1)) / light.mean((0, 1)))).max() < 0.01
        assert np.abs(frame_light - light).max() < 0.02


def test_a_clip_whose_cameras_are_not_found_is_named_itself(tmp_path, monkeypatch):
    def place(dataset, _):
        raise InputError(dataset.folder, "none of the 24 photos could be placed", "bring poses")

    monkeypatch.setattr("sehdr_warp.scene.load.place_photos", place)
    write_clip(tmp_path / "a.mov", list(pan(30)))
    with pytest.raises(InputError, match=r"a\.mov: none of the 24 frames could be placed; film slowly"):
        load_scene(tmp_path / "a.mov", cache=tmp_path / "cache")
