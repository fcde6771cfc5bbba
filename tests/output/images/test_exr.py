import json
from datetime import datetime

import numpy as np
import OpenEXR
import pytest

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.images.exr import (
    Part,
    exr_header,
    rgb_channels,
    stored_pixel_type,
    write_exr,
    write_multipart_exr,
    write_radiance,
)
from sehdr_warp.scene import Camera
from sehdr_warp.scene.images.hdr_files import read_hdr

from ...full_disk import full_disk
from ..helpers import camera, radiance, read_exr


def read_openimageio(path, subimage=0):
    OpenImageIO = pytest.importorskip("OpenImageIO")
    buffer = OpenImageIO.ImageBuf(str(path), subimage, 0)
    assert not buffer.has_error, buffer.geterror()
    return buffer.get_pixels(OpenImageIO.FLOAT), buffer.spec()


@pytest.mark.parametrize("pixel, dtype", [("half", np.float16), ("float", np.float32)])
def test_both_readers_give_back_the_rounded_pixels(tmp_path, pixel, dtype):
    image = radiance()
    alpha, depth = np.full(image.shape[:2], 0.3), image[..., 0] * 1.0001
    channels = rgb_channels(image) | {"A": alpha, "Z": depth, "confidence": alpha / 2}
    assert write_exr(tmp_path / "a.exr", channels, pixel=pixel) == pixel

    pixels, names, header = read_exr(tmp_path / "a.exr")
    assert names == ("R", "G", "B", "A", "Z", "confidence")
    np.testing.assert_array_equal(pixels[..., :3], image.astype(dtype))
    np.testing.assert_array_equal(pixels[..., 3], alpha.astype(dtype))
    np.testing.assert_array_equal(pixels[..., 4], depth.astype(np.float32))
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION

    other, spec = read_openimageio(tmp_path / "a.exr")
    np.testing.assert_array_equal(other, pixels)
    assert [str(kind) for kind in spec.channelformats or ["float"] * 6] == [pixel] * 4 + ["float"] + [pixel]


def test_metadata_reaches_both_readers(tmp_path):
    view = camera()
    header = exr_header(
        colorspace="acescg",
        exposure_time=0.1,
        camera=view,
        captured=datetime(2025, 1, 2, 3, 4, 5),
        provenance={"scene": "room", "iteration": "7"},
    )
    write_exr(tmp_path / "a.exr", rgb_channels(radiance()), header=header)
    _, _, attributes = read_exr(tmp_path / "a.exr")
    assert attributes["expTime"] == np.float32(0.1) and float(attributes["sehdr:exposureTime"]) == 0.1
    assert attributes["capDate"] == "2025:01:02 03:04:05"
    assert attributes["sehdr:scene"] == "room" and attributes["sehdr:pixelType"] == "half"
    assert attributes["colorInteropID"] == "lin_ap1_scene"
    np.testing.assert_allclose(attributes["chromaticities"][:2], (0.713, 0.293), atol=1e-6)
    np.testing.assert_allclose(attributes["pixelAspectRatio"], view.fy / view.fx, rtol=1e-6)
    assert json.loads(attributes["sehdr:camera"]) == view.to_dict()

    _, spec = read_openimageio(tmp_path / "a.exr")
    assert spec.get_float_attribute("ExposureTime") == np.float32(0.1)
    assert spec.get_string_attribute("DateTime") == "2025:01:02 03:04:05"
    np.testing.assert_allclose(np.reshape(spec.getattribute("worldToCamera"), (4, 4)), attributes["worldToCamera"])


def test_radiance_files_hold_light_within_a_part_in_256_of_the_largest_channel(tmp_path):
    light = np.random.default_rng(0).uniform(0, 1, (5, 9, 3)) * np.exp2(np.linspace(-40, 40, 9))[:, None]
    light[2] = 0.0
    write_radiance(tmp_path / "a.hdr", light)
    read = read_hdr(tmp_path / "a.hdr")
    assert (np.abs(read - light) <= light.max(axis=2, keepdims=True) / 128).all() and not read[2].any()


def test_camera_matrices_follow_their_conventions():
    view = camera(position=(1.0, 0.5, -3.0), target=(0.2, 0.1, 0.3))
    header = exr_header(camera=view)
    point = np.array([0.3, -0.2, 0.4, 1.0])
    x, y, z, _ = view.world_to_camera @ point
    np.testing.assert_allclose((point @ header["worldToCamera"])[:3], (x, -y, -z), rtol=1e-5)
    ndc = point @ header["worldToNDC"]
    pixel = (view.fx * x / z + view.cx, view.fy * y / z + view.cy)
    np.testing.assert_allclose(ndc[:2] / ndc[3] * (view.width, view.height), pixel, rtol=1e-5)
    # The screen window: left edge at pixel 0, right edge at the width; its x axis points left.
    left = header["screenWindowCenter"][0] + header["screenWindowWidth"] / 2
    np.testing.assert_allclose(-left * view.fx + view.cx, 0, atol=1e-5)


def test_a_panorama_states_its_pose_and_no_screen():
    view = Camera(128, 64, 20.4, 20.4, 64.0, 32.0, np.eye(4), "equirectangular")
    header = exr_header(camera=view)
    assert "worldToCamera" in header and json.loads(header["sehdr:camera"])["projection"] == "equirectangular"
    assert not {"worldToNDC", "screenWindowCenter", "screenWindowWidth"} & set(header)


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_values_that_are_not_finite_are_refused_with_their_place(tmp_path, value):
    image = radiance()
    image[5, 7, 1] = value
    with pytest.raises(InputError, match=rf"a.exr: channel G: 1 values are not finite, the first {value} at x=7, y=5"):
        write_exr(tmp_path / "a.exr", rgb_channels(image))
    assert list(tmp_path.iterdir()) == []


def test_half_overflow_becomes_float_and_says_so(tmp_path):
    image = radiance()
    image[2, 3, 0] = 70000.0
    assert write_exr(tmp_path / "a.exr", rgb_channels(image)) == "float"
    pixels, _, header = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(pixels, image)
    assert header["sehdr:pixelType"] == "float, since half would overflow 65504"
    # The largest half itself is held by half.
    image[2, 3, 0] = 65504.0
    assert write_exr(tmp_path / "b.exr", rgb_channels(image)) == "half"
    assert stored_pixel_type([np.array([-65505.0])]) == "float"
    with pytest.raises(InputError, match="past 32-bit floats"):
        write_exr(tmp_path / "c.exr", rgb_channels(image.astype(np.float64) * 1e38))


def test_full_disk_is_one_line_and_leaves_nothing(tmp_path):
    with pytest.raises(SehdrError, match="a.exr: cannot be written") as caught, full_disk():
        write_exr(tmp_path / "a.exr", rgb_channels(radiance(200, 200)))
    assert "\n" not in str(caught.value) and ".tmp" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_shapes_must_agree(tmp_path):
    with pytest.raises(ValueError, match="shapes"):
        write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 3)), "G": np.zeros((3, 2))})
    with pytest.raises(SehdrError, match="pixel type"):
        write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 3))}, pixel="double")
    part = Part({"R": np.zeros((2, 3))}, {}, "b0")
    with pytest.raises(ValueError, match="one name each"):
        write_multipart_exr(tmp_path / "n.exr", [part, part])
