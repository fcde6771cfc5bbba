"""Responses measured from exposure stacks: of known curves, of real cameras, and stacks that tell nothing."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

import sehdr_warp as sw
from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name
from sehdr_warp.response.calibration import calibrate_codes
from sehdr_warp.scene.commands import Calibrate, run_calibrate
from sehdr_warp.scene.exposure.stack import read_stack
from sehdr_warp.scene.images.ldr_files import read_ldr

CODES = np.arange(10, 246) / 255


def light(seed=0, size=(96, 128)) -> np.ndarray:
    """[H, W, 3] smooth radiance over some ten stops."""
    field = gaussian_filter(np.random.default_rng(seed).normal(size=(*size, 3)), (5, 5, 0))
    return np.exp(1.6 * field / field.std())


def photograph(curve, radiance, times, noise=0.0, white=255) -> list[np.ndarray]:
    rng, middle = np.random.default_rng(1), float(curve.decode(0.5))
    values = [np.asarray(curve.encode(radiance * middle * time)) for time in times]
    codes = [np.rint(value * white + rng.normal(size=value.shape) * noise).clip(0, white) for value in values]
    return [each.astype(np.uint8 if white == 255 else np.uint16) for each in codes]


def stops_off(response, truth) -> float:
    """The largest difference over the well-exposed codes, stops, after one scale."""
    difference = np.log2(response.decode(CODES)) - np.log2(truth.decode(CODES))
    return float(abs(difference - difference.mean()).max())


def write_stack(folder, photos, times=None):
    folder.mkdir()
    for number, photo in enumerate(photos):
        Image.fromarray(photo).save(folder / f"{number}.png")
    if times is not None:
        listed = {f"{number}.png": time for number, time in enumerate(times)}
        (folder / "exposures.json").write_text(json.dumps(listed))
    return folder


@pytest.mark.parametrize("name, noise, times", [
    *((name, 0.0, (1 / 16, 1 / 4, 1, 4, 16)) for name in ("srgb", "hdr-nerf", "camera", "linear")),
    ("camera", 0.5, (1 / 8, 1, 8)),
])  # fmt: skip
def test_a_known_curve_is_found(name, noise, times):
    truth = response_by_name(name)
    calibrated = calibrate_codes(photograph(truth, light(), times, noise), times)
    assert stops_off(calibrated.response, truth) < 0.05
    assert (
        calibrated.residual < 0.05
        and max(calibrated.channel_spread) < 0.05
        and max(map(abs, calibrated.photo_offsets)) < 0.05
    )
    decoded = calibrated.response.decode(np.arange(256) / 255)
    assert (np.diff(decoded) > 0).all() and decoded[255] == pytest.approx(1.0)


def test_sixteen_bits_and_what_moved():
    truth, times = response_by_name("srgb"), (0.25, 1.0, 4.0)
    photos = photograph(truth, light(), times, white=65535)
    assert stops_off(calibrate_codes(photos, times).response, truth) < 0.03
    photos = photograph(truth, light(), times)
    photos[1][20:40, 30:50] = 128  # Something stood there for one photo.
    assert stops_off(calibrate_codes(photos, times).response, truth) < 0.06


def test_a_third_of_the_pixels_that_moved_does_not_matter():
    truth, times = response_by_name("camera"), (1 / 16, 1 / 4, 1, 4, 16)
    photos = photograph(truth, light(), times)
    for photo, other in zip(photos[1::2], photograph(truth, light(5), times)[1::2], strict=True):
        photo[:, :43] = other[:, :43]
    assert stops_off(calibrate_codes(photos, times).response, truth) < 0.1


def test_black_above_code_0_is_no_light(tmp_path, logged):
    """Scanned film and lifted blacks: each channel has its own black, and short exposures show nothing else."""
    truth, times = response_by_name("camera"), tuple(2.0**stop for stop in range(-16, 5, 2))
    blacks = np.array([13, 18, 16])
    photos = [
        np.rint(blacks + photo * (1 - blacks / 255)).astype(np.uint8)
        for photo in photograph(truth, light(), times, noise=0.5)
    ]
    response = sw.calibrate(write_stack(tmp_path / "film", photos, times))
    codes = np.arange(40, 246)
    off = np.log2(response.decode(codes / 255)) - np.log2(truth.decode((codes - 16) / 239))
    assert np.ptp(off) < 0.4
    assert not any("than its time says" in line for line in logged)  # Nothing tells what the black photos show.


def test_a_time_that_is_two_stops_off_is_found_though_its_photo_counts_little():
    times = (1 / 16, 1 / 4, 1, 4, 16)
    photos = photograph(response_by_name("srgb"), 8 * light(), times)
    offsets = calibrate_codes(photos, (*times[:-1], 64)).photo_offsets
    assert offsets[-1] == pytest.approx(-2, abs=0.1) and max(map(abs, offsets[:-1])) < 0.1


def test_a_photo_of_something_else_is_named(tmp_path, logged):
    times = (1 / 16, 1 / 4, 1, 4, 16)
    photos = photograph(response_by_name("srgb"), light(), times)
    photos[3] = photos[3][::-1, ::-1]
    sw.calibrate(write_stack(tmp_path / "stack", photos, times))
    (line,) = (line for line in logged if "leave it out" in line)
    assert line.startswith("half of 3.png differs by ")


@pytest.mark.parametrize("white", [245, 220])
def test_white_below_code_255_is_a_bound(white):
    """Stacks of video frames, or of photos whose editor lowered the white, still give the curve."""
    truth, times = response_by_name("srgb"), (1 / 16, 1 / 4, 1, 4, 16)
    photos = [np.minimum(photo, white) for photo in photograph(truth, light(), times)]
    codes = np.arange(20, white - 5) / 255
    off = np.log2(calibrate_codes(photos, times).response.decode(codes)) - np.log2(truth.decode(codes))
    assert np.ptp(off) < 0.15


def test_channels_that_differ_are_said_and_the_curve_can_be_read(tmp_path, logged):
    times = (0.25, 1.0, 4.0)
    photos = photograph(response_by_name("srgb"), light(), times)
    for photo, blue in zip(photos, photograph(response_by_name("filmic"), light(), times), strict=True):
        photo[..., 2] = blue[..., 2]
    folder = write_stack(tmp_path / "stack", photos, times)
    response = sw.calibrate(folder, out=tmp_path / "camera.csv")
    assert sum("the channels' curves differ" in line for line in logged) == 1
    again = response_by_name(tmp_path / "camera.csv")
    np.testing.assert_allclose(again.decode(CODES), response.decode(CODES), rtol=1e-6)
    assert Image.open(tmp_path / "camera.png").width > 500
    with pytest.raises(InputError, match="exists already"):
        sw.calibrate(folder, out=tmp_path / "camera.csv")
    with pytest.raises(InputError, match="curve.png: the curve is a CSV file; name it curve.csv"):
        sw.calibrate(folder, out=tmp_path / "curve.png")
    assert not list(tmp_path.glob("curve.*"))
    assert stops_off(sw.calibrate(folder, times=times, channel="red"), response_by_name("srgb")) < 0.05


def test_the_curve_is_printed_as_a_shell_reads_it(tmp_path, capsys):
    times = (0.25, 1.0, 4.0)
    folder = write_stack(tmp_path / "stack", photograph(response_by_name("srgb"), light(), times), times)
    run_calibrate(Calibrate(stack=folder, out=tmp_path / "my camera.csv"))
    assert f"--response '{tmp_path / 'my camera.csv'}'" in capsys.readouterr().out


def test_useless_stacks_get_one_line(tmp_path):
    curve, times = response_by_name("srgb"), (0.25, 1.0, 4.0)
    good = photograph(curve, light(), times)
    moved = [np.roll(photo, 25 * number, axis=1) for number, photo in enumerate(good)]
    black = [np.zeros((64, 64, 3), np.uint8)] * 3
    for place, (photos, exposure_times, words) in enumerate((
        (good[:1], times[:1], "not an exposure stack"),
        (good, (1.0, 1.0, 1.0), "same exposure time"),
        (good, times[::-1], "darker than one of shorter"),
        (moved, times, "contradict each other"),
        (black, times, "fewer than 256 pixels are well exposed"),
        ([*good[:2], good[2][:50]], times, "differ in size"),
        (good, None, "state no exposure times"),
    )):  # fmt: skip
        folder = write_stack(tmp_path / str(place), photos, exposure_times)
        with pytest.raises(InputError, match=words) as error:
            sw.calibrate(folder, out=tmp_path / "camera.csv")
        assert str(folder) in str(error.value) and "\n" not in str(error.value)
    assert not (tmp_path / "camera.csv").exists()
    with pytest.raises(InputError, match="not a folder of photos"):
        sw.calibrate(tmp_path)
    with pytest.raises(InputError, match="2 times are given"):
        sw.calibrate(folder, times=(1, 2))
    next(folder.glob("*.png")).write_bytes(b"cut")
    with pytest.raises(InputError, match=r"\.png: is not a readable image"):
        sw.calibrate(folder, times=times)


@pytest.mark.parametrize("name", ["frobisher", "library_window_sonyA6000"])
def test_real_cameras(shared, name):
    """The photos agree, channels do too, half of many photos tells what all tell, and no camera is sRGB."""
    files, times = read_stack(shared / "data" / "stacks" / name)
    codes = [read_ldr(file).pixels for file in files]
    calibrated = calibrate_codes(codes, times)
    assert calibrated.residual < 0.1 and max(calibrated.channel_spread) < 0.1
    if len(times) > 5:
        assert stops_off(calibrate_codes(codes[::2], times[::2]).response, calibrated.response) < 0.3
    assert stops_off(calibrated.response, response_by_name("srgb")) > 0.8
