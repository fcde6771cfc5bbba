"""Folders of bare photos that are an exposure stack from one place, and those that only look a little like one."""

import json

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.exposure.stack import calibrate


class Matched(Exception):
    """The photos went to structure from motion."""


@pytest.fixture(autouse=True)
def unmatched(monkeypatch):
    def reconstruct(*_):
        raise Matched

    monkeypatch.setattr("sehdr_warp.scene.readers.bare_photos.reconstruct", reconstruct)


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
        codes[0, 0] = index  # No two photos have the same bytes.
        Image.fromarray(codes.round().astype(np.uint8)).convert("RGB").save(folder / f"{index}.png")
    times_by_name = {f"{index}.png": time for index, time in enumerate(times) if time}
    (folder / "exposures.json").write_text(json.dumps(times_by_name))
    return folder


def test_a_stack_from_one_place_is_named_before_it_is_matched(tmp_path, caplog):
    folder = write_photos(tmp_path / "my stack", (8.0, 0.125, 1.0))
    with pytest.raises(InputError) as caught, caplog.at_level("INFO"):
        load_scene(folder)
    assert "comparing exposures: 3" in caplog.text
    message = str(caught.value)
    assert "3 photos are an exposure stack from one place (1/8 s to 8 s)" in message
    assert f"`sehdr-warp calibrate '{folder}' --out camera.csv`" in message


@pytest.mark.parametrize(
    "times",
    [
        (1.0, 1.0, 8.0),
        (0.5, 0.63, 0.8, 1.0, 1.26, 1.6),  # Thirds of stops
        (0.004, 0.125, 0.5, 2.0, 8.0, 500.0),  # Black and white ones at the ends
        (0.125, None, 8.0),
    ],
)
def test_any_steps_between_the_times_make_a_stack(tmp_path, times):
    with pytest.raises(InputError, match=f"{len(times)} photos are an exposure stack from one place"):
        load_scene(write_photos(tmp_path / "photos", times))


@pytest.mark.parametrize(("times", "shift"), [((0.125, 1.0, 8.0), 12), ((1.0, 1.2, 1.4), 0), ((None, None, None), 0)])
def test_other_photos_are_matched(tmp_path, times, shift):
    with pytest.raises(Matched):
        load_scene(write_photos(tmp_path / "photos", times, shift))


def test_a_curve_for_each_channel_is_calibrated(tmp_path):
    rng = np.random.default_rng(0)
    light = 2.0 ** rng.uniform(-8, 0, (60, 80, 1)).repeat(3, 2)
    (tmp_path / "stack").mkdir()
    for k in range(6):
        exposure = np.clip(light * 2.0 ** (k - 1), 0, 1)
        codes = np.stack([exposure[..., c] ** (1 / gamma) for c, gamma in enumerate((1.8, 2.2, 2.6))], axis=2)
        Image.fromarray((255 * codes).round().astype(np.uint8)).save(tmp_path / "stack" / f"{k}.png")
    calibrate(tmp_path / "stack", times=[2.0**k for k in range(6)], channel="each", out=tmp_path / "camera.csv")
    response = response_by_name(str(tmp_path / "camera.csv"))
    codes = np.array([40, 80, 200], np.uint8)[:, None, None].repeat(3, 2)
    for channel, gamma in enumerate((1.8, 2.2, 2.6)):
        stops = np.diff(np.log2(response.curves[channel].decode(codes[:, 0, 0] / 255)))
        np.testing.assert_allclose(stops, gamma * np.diff(np.log2([40, 80, 200])), atol=0.08)
    grey = response.decode(response.to_shared(np.full((1, 1, 3), 128, np.uint8)) / 65535)
    assert np.ptp(grey) < 0.02 * grey.mean()
