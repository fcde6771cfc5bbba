"""Which frames of a clip become photos, and where they are kept."""

import logging

import numpy as np
import pytest

from sehdr_warp.scene.images import read_ldr
from sehdr_warp.scene.names import list_images
from sehdr_warp.scene.video import open_clip
from sehdr_warp.scene.video_frames import choose_frames, frames_folder

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
