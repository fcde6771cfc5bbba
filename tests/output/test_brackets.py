import json
import re
from fractions import Fraction

import numpy as np
import pytest
import torch
from PIL import Image

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.brackets import bracket_exposures, write_brackets
from sehdr_warp.output.images.ldr_files import exposure_exif
from sehdr_warp.scene.images.ldr_files import read_ldr

from .helpers import GammaResponse, camera, radiance, read_exr
from .images.test_exr import read_openimageio

EXIF_IFD, EXPOSURE_TIME, EXPOSURE_BIAS = 0x8769, 0x829A, 0x9204


def test_exposures_ascend_and_are_of_the_one_grammar():
    bracket = bracket_exposures(0.5, evs=[2, -4, 0])
    assert [(e.time, e.ev, e.label) for e in bracket] == [(1 / 32, -4, "ev-4.0"), (0.5, 0, "ev+0.0"), (2, 2, "ev+2.0")]
    for words in ([8, 0.125], "1/8, 8s", "1/4x,+4ev"):
        assert [(e.time, e.ev) for e in bracket_exposures(0.5, exposures=words)] == [(0.125, -2), (8, 4)]
    assert bracket_exposures(0.5, evs="-2,4") == bracket_exposures(0.5, evs=[4, -2])
    assert bracket_exposures(1.0, evs=[-0.01])[0].label == "ev+0.0"


@pytest.mark.parametrize(
    "words, message",
    [  # The grammar's own refusals are field's to test.
        ({"evs": [0], "exposures": [1]}, "both are set"),
        ({}, "neither is set"),
        ({"evs": [0, float("nan")]}, "evs: nan is not a number of stops"),
        ({"exposures": [2, 1, "4x"]}, "exposures: 2 s appears twice"),
        ({"evs": [1, 1.0]}, "evs: 1 s appears twice"),
        ({"evs": ""}, "evs: the list is empty"),
        ({"evs": "0,two"}, "evs: 'two' is not a number of stops; write numbers"),
        ({"exposures": [1e-30]}, "exposures: 1e-30 s .* is outside"),
    ],
)
def test_unusable_exposures_name_the_value(words, message):
    with pytest.raises(SehdrError, match=message):
        bracket_exposures(0.5, **words)
    with pytest.raises(SehdrError, match="base exposure time = -1"):
        bracket_exposures(-1, evs=[0])
    with pytest.raises(SehdrError, match="base exposure time = '1/125' is not a positive number of seconds"):
        bracket_exposures("1/125", evs=[0])


@pytest.mark.parametrize("pixel, dtype", [("half", np.float16), ("float", np.float32)])
def test_exposures_differ_by_exactly_the_ratio_of_their_times(tmp_path, pixel, dtype):
    image = radiance()
    times = [0.125, 0.3, 2.0, 1 / 3]
    files = write_brackets(tmp_path, {"r_0": image}, 0.5, exposures=times, pixel=pixel)
    assert [file.stem for file in files] == ["r_0_b0_ev-2.0", "r_0_b1_ev-0.7", "r_0_b2_ev-0.6", "r_0_b3_ev+2.0"]
    read = [read_exr(file)[0].astype(np.float64) for file in files]
    for time, pixels in zip(sorted(times), read, strict=True):
        np.testing.assert_array_equal(pixels, (image.astype(np.float64) * time).astype(dtype))
    # Whole stops differ by a power of two to the last bit, except in half's denormals.
    exact = read[0] >= 2.0**-14
    assert exact.mean() > 0.5
    np.testing.assert_array_equal((read[3] / 16)[exact], read[0][exact])
    ratio = read[2] / read[1]
    bound = 2.0 * np.finfo(dtype).eps
    np.testing.assert_allclose(ratio[exact], (1 / 3) / 0.3, rtol=bound)


def test_names_of_many_exposures_sort_as_these_do(tmp_path):
    files = write_brackets(tmp_path, {"r_0": radiance()}, 0.5, evs=range(-5, 6))
    assert [file.name for file in files] == sorted(file.name for file in files) and len(files) == 11


def test_manifest_lists_what_was_written(tmp_path):
    views = {"r_0": radiance(), "../a/b": radiance(seed=1), "R_0": radiance(seed=2)}
    files = write_brackets(tmp_path, views, 0.5, evs=[-2, 0, 2], cameras={"r_0": camera()}, colorspace="rec2020")
    manifest = json.loads((tmp_path / "brackets.json").read_text())
    assert manifest["base_exposure_time"] == 0.5 and manifest["color_space"] == "rec2020"
    assert [view["view"] for view in manifest["views"]] == ["r_0", "_a_b", "R_0_2"]
    listed = [tmp_path / exposure["file"] for view in manifest["views"] for exposure in view["exposures"]]
    assert listed == files == sorted((tmp_path / "brackets").rglob("*.exr"), key=files.index)
    assert [e["exposure_time"] for e in manifest["views"][0]["exposures"]] == [0.125, 0.5, 2.0]
    for exposure in manifest["views"][2]["exposures"]:
        _, spec = read_openimageio(tmp_path / exposure["file"])
        assert spec.get_float_attribute("ExposureTime") == exposure["exposure_time"]
        assert float(spec.get_string_attribute("sehdr:ev")) == exposure["ev"]


def test_views_of_one_name_are_all_written(tmp_path):
    images = radiance(), radiance(seed=1)
    files = write_brackets(tmp_path, iter([("r_0", image) for image in images]), 0.5, evs=[0], pixel="float")
    assert [file.name for file in files] == ["r_0_b0_ev+0.0.exr", "r_0_2_b0_ev+0.0.exr"]
    for file, image in zip(files, images, strict=True):
        np.testing.assert_allclose(read_exr(file)[0], image / 2, rtol=1e-6)


def test_multipart_holds_all_exposures_of_a_view(tmp_path):
    image = radiance()
    files = write_brackets(tmp_path, {"r_0": image, "r_1": image}, 0.5, evs=[-1, 0, 1], multipart=True)
    assert files == [tmp_path / "brackets" / "r_0.exr", tmp_path / "brackets" / "r_1.exr"]
    manifest = json.loads((tmp_path / "brackets.json").read_text())
    for exposure in manifest["views"][1]["exposures"]:
        pixels, spec = read_openimageio(tmp_path / exposure["file"], exposure["part"])
        np.testing.assert_array_equal(pixels, (image * exposure["exposure_time"]).astype(np.float16))
        assert spec.get_float_attribute("ExposureTime") == exposure["exposure_time"]


def test_photos_of_an_earlier_call_do_not_stay_beside_new_brackets(tmp_path):
    write_brackets(tmp_path, {"v": radiance()}, 0.5, evs=[0], ldr="png", response=GammaResponse())
    write_brackets(tmp_path, {"v": radiance()}, 0.5, evs=[1], overwrite=True)
    assert not (tmp_path / "brackets_ldr").exists()


@pytest.mark.parametrize("multipart", [False, True])
def test_one_exposure_past_half_makes_the_whole_bracket_float(tmp_path, multipart):
    files = write_brackets(tmp_path, {"v": radiance() * 100}, 0.5, evs=[-2, 8], multipart=multipart)
    assert json.loads((tmp_path / "brackets.json").read_text())["views"][0]["pixel"] == "float"
    for file in files:
        assert read_exr(file)[2]["sehdr:pixelType"] == "float, since half would overflow 65504"
    if not multipart:
        assert read_exr(files[1])[0].max() > 65504


def test_nothing_is_replaced_or_left_half_done(tmp_path):
    write_brackets(tmp_path, {"v": radiance()}, 0.5, evs=[0])
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="exists already"):
        write_brackets(tmp_path, {"v": radiance()}, 0.5, evs=[1])
    broken = radiance()
    broken[1, 2, 0] = np.nan
    with pytest.raises(InputError, match="R = nan at x=2, y=1"):
        write_brackets(tmp_path, {"v": radiance(), "w": broken}, 0.5, evs=[1], overwrite=True)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    with pytest.raises(InputError):
        write_brackets(tmp_path / "new", {"w": broken}, 0.5, evs=[1])
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("kind, suffix", [("jpeg", "jpg"), ("png", "png"), ("png16", "png")])
def test_photos_carry_their_exposure_times(tmp_path, kind, suffix):
    image = radiance()
    write_brackets(tmp_path, {"v": image}, 0.5, evs=[-2, 1 / 3], ldr=kind, response=GammaResponse())
    manifest = json.loads((tmp_path / "brackets.json").read_text())
    assert manifest["response"] == "gamma-2.2"
    for exposure in manifest["views"][0]["exposures"]:
        file = tmp_path / exposure["ldr_file"]
        assert file.suffix == f".{suffix}"
        details = Image.open(file).getexif().get_ifd(EXIF_IFD)
        assert float(details[EXPOSURE_TIME]) == pytest.approx(exposure["exposure_time"], rel=1e-9)
        assert float(details[EXPOSURE_BIAS]) == pytest.approx(exposure["ev"], rel=1e-8)
        encoded = GammaResponse().encode(image.astype(np.float64) * exposure["exposure_time"])
        stored = read_ldr(file)
        tolerance = 0.5 / stored.levels if kind != "jpeg" else 0.2
        assert stored.levels == (65535 if kind == "png16" else 255)
        assert np.abs(stored.pixels / stored.levels - encoded).max() <= tolerance * 1.0001
    first = manifest["views"][0]["exposures"][0]["ldr_file"]
    assert Fraction(Image.open(tmp_path / first).getexif().get_ifd(EXIF_IFD)[EXPOSURE_TIME]) == Fraction(1, 8)


def test_exif_times_are_simple_fractions():
    for time, expected in ((1 / 400, (1, 400)), (0.1, (1, 10)), (32.0, (32, 1)), (1 / 3, (1, 3)), (1e-6, (1, 10**6))):
        value = exposure_exif(time).get_ifd(EXIF_IFD)[EXPOSURE_TIME]
        assert (value.numerator, value.denominator) == expected


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64, bool, complex])
def test_codes_are_not_taken_for_radiance(tmp_path, dtype):
    codes = np.ones((3, 4, 3), dtype)
    name = re.escape(f"views['a'] has dtype {codes.dtype}, which is not radiance; pass radiance as floats")
    for views in ({"a": codes}, {"a": torch.from_numpy(codes)}):
        with pytest.raises(TypeError, match=name):
            write_brackets(tmp_path, views, 1, evs=[0])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_floats_of_any_width_and_tensors_are_radiance(tmp_path, dtype):
    image = radiance().astype(dtype)
    for place, view in (("array", image), ("tensor", torch.from_numpy(image)), ("list", image.tolist())):
        [file] = write_brackets(tmp_path / place, {"a": view}, 1, evs=[0], pixel="float")
        np.testing.assert_array_equal(read_exr(file)[0], image.astype(np.float32))


def test_unusable_options(tmp_path):
    picture = np.ones((3, 4, 3), np.float32)
    for views in ([picture], picture, [("a", picture, 1)]):
        with pytest.raises(TypeError, match="views is neither a dict of names and their radiance"):
            write_brackets(tmp_path / "x", views, 1, evs=[0])
    with pytest.raises(ValueError, match=r"radiance has shape \(0, 4, 3\), not \[H, W, 3\]"):
        write_brackets(tmp_path / "x", {"a": picture[:0]}, 1, evs=[0])
    assert not list(tmp_path.iterdir())
    with pytest.raises(SehdrError, match="'gif' are not one of"):
        write_brackets("x", {}, 1, evs=[0], ldr="gif", response=GammaResponse())
    with pytest.raises(SehdrError, match="need a camera response"):
        write_brackets("x", {}, 1, evs=[0], ldr="png")
    with pytest.raises(SehdrError, match="color space"):
        write_brackets("x", {}, 1, evs=[0], colorspace="cmyk")
