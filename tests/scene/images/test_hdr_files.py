"""OpenEXR and Radiance files: values, windows, primaries, interop IDs, luminance and chroma, exposure times."""

import json
import struct

import colour
import numpy as np
import OpenEXR
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.output.images.exr import write_radiance
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.images.hdr_files import exr_exposure_time, hdr_size, read_hdr, read_light
from tests.make_scenes import edited_json, pattern, write_blender

RNG = np.random.default_rng(1)
RGB = np.array([0.8, 0.2, 0.05], np.float32)
SPACES = {"lin_ap1_scene": "ACEScg", "lin_ap0_scene": "ACES2065-1", "lin_p3d65_scene": "Display P3",
          "lin_rec2020_scene": "ITU-R BT.2020", "lin_adobergb_scene": "Adobe RGB (1998)"}  # fmt: skip


def write_exr(path, channels, **header):
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **header}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


def planes(rgb=RGB, shape=(6, 8)):
    return {name: np.full(shape, value, np.float32) for name, value in zip("RGB", rgb)}


def space(name):
    copied = colour.RGB_COLOURSPACES[name].copy()
    copied.use_derived_transformation_matrices(True)
    return copied


def rec709(name, rgb=RGB):
    return np.asarray(rgb, float) @ colour.matrix_RGB_to_RGB(space(name), space("ITU-R BT.709"), "Bradford").T


@pytest.mark.parametrize("interop", SPACES)
def test_primaries_by_chromaticities_and_by_interop_id(tmp_path, interop):
    copied, expected = space(SPACES[interop]), rec709(SPACES[interop])
    places = tuple(map(float, (*np.ravel(copied.primaries), *copied.whitepoint)))
    for header in ({"chromaticities": places}, {"colorInteropID": interop}):
        read = read_hdr(write_exr(tmp_path / "a.exr", planes(), **header))
        np.testing.assert_allclose(read[2, 3], expected, rtol=2e-3, atol=1e-4)


def test_encoded_values_of_an_interop_id(tmp_path):
    read = read_hdr(write_exr(tmp_path / "a.exr", planes((0.5, 0.5, 0.5)), colorInteropID="srgb_rec709_scene"))
    assert read[0, 0, 0] == pytest.approx(0.21404, rel=1e-3)
    read = read_hdr(write_exr(tmp_path / "b.exr", planes((0.5, 0.5, 0.5)), colorInteropID="g22_ap1_scene"))
    assert read[0, 0, 0] == pytest.approx(0.5**2.2, rel=2e-3)


def write_subsampled(path, channels, shape):
    """An uncompressed file of float channels {name: (values, step)}; the Python module writes none with steps."""
    height, width = shape
    names = sorted(channels)

    def attribute(name, kind, data):
        return f"{name}\0{kind}\0".encode() + struct.pack("<i", len(data)) + data

    listed = b"".join(f"{n}\0".encode() + struct.pack("<iB3xii", 2, 0, channels[n][1], channels[n][1]) for n in names)
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    head = b"\x76\x2f\x31\x01\2\0\0\0" + attribute("channels", "chlist", listed + b"\0")
    head += attribute("compression", "compression", b"\0") + attribute("dataWindow", "box2i", box)
    head += attribute("displayWindow", "box2i", box) + attribute("lineOrder", "lineOrder", b"\0")
    head += attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    head += attribute("screenWindowCenter", "v2f", bytes(8)) + attribute(
        "screenWindowWidth", "float", struct.pack("<f", 1)
    )
    head += b"\0"
    lines, offsets, place = [], [], len(head) + 8 * height
    for y in range(height):
        data = b"".join(
            channels[n][0][y // channels[n][1]].astype("<f4").tobytes() for n in names if y % channels[n][1] == 0
        )
        offsets.append(place)
        lines.append(struct.pack("<ii", y, len(data)) + data)
        place += len(lines[-1])
    path.write_bytes(head + struct.pack(f"<{height}Q", *offsets) + b"".join(lines))


@pytest.mark.parametrize("step", [1, 2])
def test_luminance_and_chroma(tmp_path, step):
    rgb = np.stack([np.full((8, 8), value, np.float32) for value in (0.6, 0.3, 0.1)], axis=2)
    luminance = (rgb @ space("ITU-R BT.709").matrix_RGB_to_XYZ[1]).astype(np.float32)
    channels = {"Y": (luminance, 1)}
    for name, values in (("RY", rgb[..., 0]), ("BY", rgb[..., 2])):
        channels[name] = (values / luminance - 1)[::step, ::step], step
    write_subsampled(tmp_path / "a.exr", channels, (8, 8))
    np.testing.assert_allclose(read_hdr(tmp_path / "a.exr"), rgb, rtol=2e-3)


def test_xyz_channels(tmp_path):
    xyz = space("ITU-R BT.709").matrix_RGB_to_XYZ @ RGB
    read = read_hdr(write_exr(tmp_path / "a.exr", {n: np.full((4, 4), v, np.float32) for n, v in zip("XYZ", xyz)}))
    assert read.shape == (4, 4, 3) and read[0, 0, 0] > read[0, 0, 1] > read[0, 0, 2]


@pytest.mark.parametrize(
    "places", [(0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.3, 0.3), (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3, 0)]
)
def test_primaries_that_span_no_colors_are_refused(tmp_path, places):
    with pytest.raises(InputError, match=r"a.exr: chromaticities .* span no colors"):
        read_hdr(write_exr(tmp_path / "a.exr", planes(), chromaticities=tuple(map(float, places))))


def radiance(path, header):
    pixels = np.zeros((2, 4, 4), np.uint8)
    pixels[...] = (200, 50, 12, 128)
    path.write_bytes(b"#?RADIANCE\n" + header + b"\n\n-Y 2 +X 4\n" + pixels.tobytes())
    return path


def test_primaries_of_radiance(tmp_path):
    plain = read_hdr(radiance(tmp_path / "a.hdr", b"FORMAT=32-bit_rle_rgbe"))
    default = b"FORMAT=32-bit_rle_rgbe\nPRIMARIES=0.64 0.33 0.29 0.60 0.15 0.06 0.333 0.333"
    np.testing.assert_array_equal(read_hdr(radiance(tmp_path / "b.hdr", default)), plain)
    photoshop = b"GAMMA=1\nPRIMARIES=0 0 0 0 0 0 0 0\nFORMAT=32-bit_rle_rgbe"
    np.testing.assert_array_equal(read_hdr(radiance(tmp_path / "f.hdr", photoshop)), plain)
    p3 = b"FORMAT=32-bit_rle_rgbe\nPRIMARIES= .680 .320 .265 .690 .150 .060 .3127 .3290"
    np.testing.assert_allclose(
        read_hdr(radiance(tmp_path / "c.hdr", p3))[0, 0], rec709("Display P3", plain[0, 0]), rtol=2e-3
    )
    xyz = read_hdr(radiance(tmp_path / "d.hdr", b"FORMAT=32-bit_rle_xyze"))
    assert xyz[0, 0, 0] > 2 * plain[0, 0, 0]
    with pytest.raises(InputError, match="PRIMARIES"):
        read_hdr(radiance(tmp_path / "e.hdr", b"FORMAT=32-bit_rle_rgbe\nPRIMARIES=1 2 x"))


def test_exposures_and_color_corrections_of_radiance(tmp_path):
    plain = read_hdr(radiance(tmp_path / "a.hdr", b"FORMAT=32-bit_rle_rgbe"))
    changed = b"EXPOSURE=2\nCOLORCORR=1 0.5 4\nEXPOSURE= 1e1\nCOLORCORR= 2 2 2\nFORMAT=32-bit_rle_rgbe"
    read = read_hdr(radiance(tmp_path / "b.hdr", changed))
    np.testing.assert_allclose(read, plain / (np.array([1, 0.5, 4]) * 40), rtol=1e-6)
    for header in (b"EXPOSURE=0", b"COLORCORR=1 2", b"COLORCORR=1 -1 1", b"EXPOSURE=nan"):
        with pytest.raises(InputError, match="EXPOSURE or COLORCORR are not positive numbers"):
            read_hdr(radiance(tmp_path / "c.hdr", header))


def float_set(folder, light, times, stated=True):
    write_blender(folder, 6, size=(40, 30))
    with edited_json(folder / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            (folder / "images" / f"r_{i}.png").unlink()
            frame["file_path"] = f"images/r_{i}.exr"
            channels = dict(zip("RGB", np.moveaxis(light * times[i], 2, 0).astype(np.float32).copy()))
            write_exr(folder / frame["file_path"], channels, **({"expTime": times[i]} if stated else {}))
    return folder


def test_exposure_times_of_openexr(tmp_path):
    light = 0.1 + pattern(40, 30) / 255
    times = [0.01, 0.02, 0.04, 0.01, 0.02, 0.04]
    scene = load_scene(float_set(tmp_path / "a", light, times), holdout=0)
    assert any(note == "float images: their values are light times expTime, 0.01 to 0.04 s" for note in scene.notes)
    assert [view.exposure_time / scene.views[0].exposure_time for view in scene.views] == pytest.approx(
        [1, 2, 4, 1, 2, 4]
    )
    for view in scene.views:
        np.testing.assert_allclose(view.hdr, light * times[0], rtol=2e-3)
        decoded = scene.response.decode(view.image.astype(float)) / view.exposure_time
        np.testing.assert_allclose(decoded, light * times[0], rtol=0.01)
    same = load_scene(float_set(tmp_path / "b", light, [0.02] * 6), holdout=0)
    plain = load_scene(float_set(tmp_path / "c", light, [0.02] * 6, stated=False), holdout=0)
    assert same.views[0].exposure_time == plain.views[0].exposure_time
    assert exr_exposure_time(tmp_path / "b" / "images" / "r_0.exr") == pytest.approx(0.02)
    assert exr_exposure_time(tmp_path / "c" / "images" / "r_0.exr") is None


@pytest.mark.parametrize("place", ["exposures.json", "transforms.json"])
def test_exposure_times_that_the_user_states_for_openexr(tmp_path, place):
    """They replace expTime; and a set of light that lists the times of photos stays light."""
    light, times = 0.1 + pattern(40, 30) / 255, [0.01, 0.02, 0.04, 0.01, 0.02, 0.04]

    def load_with(folder, factors):
        float_set(folder, light, factors, stated=False)
        with edited_json(folder / "transforms.json") as values:
            for frame, time in zip(values["frames"], times):
                frame.pop("exposure_time", None)
                if place == "transforms.json":
                    frame["exposure_time"] = time
        if place == "exposures.json":
            (folder / place).write_text(json.dumps({f"r_{i}.exr": time for i, time in enumerate(times)}))
        return load_scene(folder, holdout=0)

    exposed, lit = load_with(tmp_path / "a", times), load_with(tmp_path / "b", [0.5] * 6)
    assert "float images: their values are light times the stated times, 0.01 to 0.04 s" in exposed.notes
    for view, time in zip(exposed.views, times, strict=True):
        np.testing.assert_allclose(view.hdr, light * times[0], rtol=2e-3)
        assert view.exposure_time / exposed.views[0].exposure_time == pytest.approx(time / times[0])
    assert any("do not follow the stated times" in note for note in lit.notes)
    for view in lit.views:
        np.testing.assert_allclose(view.hdr, light * 0.5, rtol=2e-3)
        assert view.exposure_time == lit.views[0].exposure_time


@pytest.mark.parametrize("layers, picture", [
    (["ViewLayer.Combined", "ViewLayer.Normal"], "ViewLayer.Combined"), (["beauty"], "beauty"),
    (["diffuse", "rgba", "specular"], "rgba"), (["left.main"], "left.main"),
])  # fmt: skip
def test_the_picture_of_a_file_of_layers(tmp_path, layers, picture):
    channels = {}
    for layer in layers:
        values = RGB if layer == picture else RGB * 3
        channels |= {f"{layer}.{name}": np.full((6, 8), value, np.float32) for name, value in zip("RGB", values)}
    np.testing.assert_array_equal(read_hdr(write_exr(tmp_path / "a.exr", channels))[2, 3], RGB)


def test_layers_without_a_picture_are_named(tmp_path):
    channels = {f"{layer}.{name}": np.ones((4, 4), np.float32) for layer in ("diffuse", "specular") for name in "RGB"}
    with pytest.raises(InputError, match=r"has the layers \['diffuse', 'specular'\], and none .*; export the picture"):
        read_hdr(write_exr(tmp_path / "a.exr", channels))


@pytest.mark.parametrize(
    "parts",
    [("depth", "rgb"), ("rgb", "depth"), ("diffuse", "beauty"), ("left", "right"), ("Scene.Depth", "Scene.Combined")],
)
def test_the_picture_of_a_file_of_parts(tmp_path, parts):
    """Passes may lie in parts of their own, also before the picture; of two views the first one counts."""
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    picture = (
        "left"
        if "left" in parts
        else next(name for name in parts if name.split(".")[-1] in ("rgb", "beauty", "Combined"))
    )
    written = []
    for name in parts:
        channels = {"Z": np.ones((6, 8), np.float32)} if "epth" in name else planes(RGB if name == picture else RGB * 3)
        written.append(OpenEXR.Part({**header, "expTime": 0.5 if name == picture else 2.0}, channels, name=name))
    OpenEXR.File(written).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_hdr(tmp_path / "a.exr")[2, 3], RGB)
    assert exr_exposure_time(tmp_path / "a.exr") == 0.5


def test_a_float_image_that_is_not_finite_is_left_out(tmp_path):
    float_set(tmp_path, 0.1 + pattern(40, 30) / 255, [0.01] * 6, stated=False)
    bad = planes((0.1, np.nan, 0.1), (30, 40))
    write_exr(tmp_path / "images" / "r_0.exr", bad)
    scene = load_scene(tmp_path, holdout=0)
    assert len(scene.views) == 5
    assert any(
        "1 of 6 photos cannot be used and were left out (r_0.exr: 1200 pixels not finite" in n for n in scene.notes
    )
    for i in range(6):
        write_exr(tmp_path / "images" / f"r_{i}.exr", bad)
    with pytest.raises(InputError, match="1200 pixels not finite"):
        load_scene(tmp_path)


@pytest.mark.parametrize("width", [5, 40])
def test_radiance_pictures(tmp_path, width):
    """Width 40 is run-length coded, width 5 flat; the format's own precision is one part in 256 of the brightest."""
    cv2 = pytest.importorskip("cv2")
    pixels = np.exp(RNG.normal(0, 3, (6, width, 3))).astype(np.float32)
    pixels[2] = pixels[2, 0]
    cv2.imwrite(str(tmp_path / "a.hdr"), pixels[..., ::-1])
    read = read_hdr(tmp_path / "a.hdr")
    assert np.all(np.abs(read - pixels) <= pixels.max(axis=2, keepdims=True) / 128)
    data = (tmp_path / "a.hdr").read_bytes()
    for end in (0, 5, 30, len(data) // 2, len(data) - 1):
        (tmp_path / "b.hdr").write_bytes(data[:end])
        with pytest.raises(InputError):
            read_hdr(tmp_path / "b.hdr")


def test_exr_negative_and_not_finite_values(tmp_path):
    pixels = RNG.normal(0, 1, (6, 8, 3)).astype(np.float32)
    write_exr(tmp_path / "a.exr", {"RGB": pixels})
    np.testing.assert_array_equal(read_hdr(tmp_path / "a.exr"), np.maximum(pixels, 0))
    pixels[4, 5, 1] = np.nan
    write_exr(tmp_path / "a.exr", {"RGB": pixels})
    with pytest.raises(InputError, match=r"G = nan at x=5, y=4"):
        read_hdr(tmp_path / "a.exr")


def test_exr_data_window_inside_the_display_window(tmp_path):
    pixels = np.ones((3, 4, 3), np.float32)
    corners = {"dataWindow": (np.array([2, 1], np.int32), np.array([5, 3], np.int32)),
               "displayWindow": (np.array([0, 0], np.int32), np.array([9, 7], np.int32))}  # fmt: skip
    write_exr(tmp_path / "a.exr", {"RGB": pixels}, **corners)
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        assert file.header()["dataWindow"][0].tolist() == [2, 1]
    read = read_hdr(tmp_path / "a.exr")
    assert read.shape == (8, 10, 3) and read[1:4, 2:6].min() == 1 and read.sum() == 36
    coverage = read_light(tmp_path / "a.exr").coverage
    np.testing.assert_array_equal(coverage, read[..., 0])


@pytest.mark.parametrize("name, other", [("a.hdr", "OpenEXR, not a Radiance picture; name it .exr"),
                                         ("a.exr", "a Radiance picture, not OpenEXR; name it .hdr")])  # fmt: skip
def test_light_under_the_other_suffix_is_named(tmp_path, name, other):
    write_radiance(tmp_path / "b.hdr", np.ones((4, 8, 3)))
    write_exr(tmp_path / "b.exr", {"RGB": np.ones((4, 8, 3), np.float32)})
    (tmp_path / {"a.hdr": "b.exr", "a.exr": "b.hdr"}[name]).rename(tmp_path / name)
    for read in (read_hdr, hdr_size):
        with pytest.raises(InputError, match=f"is {other}"):
            read(tmp_path / name)
