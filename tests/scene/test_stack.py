"""Folders of bare photos that are an exposure stack from one place, and those that only look a little like one."""

import json

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene


class Matched(Exception):
    """The photos went to structure from motion."""


@pytest.fixture(autouse=True)
def unmatched(monkeypatch):
    def reconstruct(*_):
        raise Matched

    monkeypatch.setattr("sehdr_warp.scene.read_folders.reconstruct", reconstruct)


def write_photos(folder, times, shift=0):
    """Photos of a smooth scene of some 8 stops in sRGB, each `shift` pixels beside the last; their times in
    exposures.json."""
    folder.mkdir()
    noise = np.fft.rfft2(np.random.default_rng(1).normal(size=(96, 128)))
    frequency = np.hypot(np.fft.fftfreq(96)[:, None], np.fft.rfftfreq(128)[None])
    stops = np.fft.irfft2(noise / (0.02 + frequency) ** 1.5)
    light = 2.0 ** (2 * stops / stops.std())
    for index, time in enumerate(times):
        codes = 255 * np.clip(0.1 * np.roll(light, shift * index, 1) * (time or 1.0), 0, 1) ** (1 / 2.2)
        Image.fromarray(codes.round().astype(np.uint8)).convert("RGB").save(folder / f"{index}.png")
    stated = {f"{index}.png": time for index, time in enumerate(times) if time}
    (folder / "exposures.json").write_text(json.dumps(stated))
    return folder


def test_a_stack_from_one_place_is_told_before_it_is_matched(tmp_path):
    folder = write_photos(tmp_path / "my stack", (8.0, 0.125, 1.0))
    with pytest.raises(InputError) as caught:
        load_scene(folder)
    told = str(caught.value)
    assert "3 photos are an exposure stack from one place (1/8 s to 8 s)" in told
    assert f"`sehdr-warp calibrate '{folder}' --out camera.csv`" in told


@pytest.mark.parametrize(
    ("times", "shift"),
    [
        ((0.125, 1.0, 8.0), 12),
        ((1.0, 1.0, 8.0), 0),
        ((1.0, 1.2, 1.4), 0),
        ((0.125, None, 8.0), 0),
        ((None, None, None), 0),
    ],
)
def test_other_photos_are_matched(tmp_path, times, shift):
    with pytest.raises(Matched):
        load_scene(write_photos(tmp_path / "photos", times, shift))
