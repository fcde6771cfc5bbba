"""TIFF of every kind, read or described."""

import struct

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene.images.ldr_files import has_16_bits, image_sizes, read_ldr, turn_upright

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["rgb", "rgb 16", "grey", "grey 16", "planes 16"])
def test_tiff_is_read_as_stored_and_upright(tmp_path, kind, orientation):
    """Pillow turns a TIFF when it loads the pixels; raw grey it misreads."""
    name, _, deep = kind.partition(" ")
    codes = RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8).astype(np.uint16 if deep else np.uint8)
    stored = {"grey": codes[..., 0], "planes": codes.transpose(2, 0, 1)}.get(name, codes)
    options = {"grey": {"photometric": "minisblack"}, "planes": {"photometric": "rgb", "planarconfig": "separate"}}
    tags = [(274, "H", 1, orientation, True)]
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "o.tif", stored, extratags=tags, **options.get(name, {"photometric": "rgb"}))
    expected = np.repeat(codes[..., :1], 3, 2) if name == "grey" else codes
    np.testing.assert_array_equal(read_ldr(tmp_path / "o.tif").pixels, expected)
    upright = turn_upright(expected, orientation)
    np.testing.assert_array_equal(read_ldr(tmp_path / "o.tif", oriented=True).pixels, upright)
    assert image_sizes(tmp_path / "o.tif") == ((7, 5), upright.shape[1::-1])


@pytest.mark.parametrize("kind", ["thumbnail", "page"])
def test_further_pictures_of_a_tiff(tmp_path, kind):
    """A thumbnail behind the photo is not a page (NewSubfileType)."""
    tifffile = pytest.importorskip("tifffile")
    photo = RNG.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(photo, photometric="rgb")
        file.write(photo[::4, ::4], photometric="rgb", subfiletype=1 if kind == "thumbnail" else 2)
    if kind == "page":
        with pytest.raises(InputError, match="holds several pictures"):
            read_ldr(tmp_path / "a.tif")
    else:
        np.testing.assert_array_equal(read_ldr(tmp_path / "a.tif").pixels, photo)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("options", [
    {"planarconfig": "separate"}, {"planarconfig": "separate", "rowsperstrip": 5},
    {"planarconfig": "separate", "compression": "deflate", "rowsperstrip": 5},
    {"extrasamples": [0]}, {"extrasamples": [2]},
    {"compression": "lzw", "predictor": True, "tile": (16, 16)}, {"bigtiff": True},
    {"bigtiff": True, "planarconfig": "separate"},
], ids=str)  # fmt: skip
def test_16_bits_of_every_kind_of_tiff(tmp_path, options, order):
    tifffile = pytest.importorskip("tifffile")
    pixels = RNG.integers(0, 65536, (21, 34, 4 if "extrasamples" in options else 3), dtype=np.uint16)
    stored = np.moveaxis(pixels, 2, 0) if "planarconfig" in options else pixels
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", byteorder=order, **options)
    if "bigtiff" in options and order == ">":
        with pytest.raises(
            InputError, match="BigTIFF whose bytes are in big-endian order, .*; save it as TIFF of less"
        ):
            read_ldr(tmp_path / "a.tif")
        return
    read = read_ldr(tmp_path / "a.tif")
    np.testing.assert_array_equal(read.pixels, pixels[..., :3])
    assert has_16_bits(tmp_path / "a.tif") and (read.alpha is not None) == (options.get("extrasamples") == [2])


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("compression", [None, "lzw"])
def test_16_bits_of_a_tiff_whose_color_is_multiplied_by_alpha(tmp_path, order, compression):
    tifffile = pytest.importorskip("tifffile")
    pixels = RNG.integers(0, 65536, (21, 34, 4), dtype=np.uint16)
    pixels[..., 3] = np.where(pixels[..., 3] < 9, 0, pixels[..., 3] | 0x4000)
    alpha = pixels[..., 3:] / 65535
    stored = pixels.copy()
    stored[..., :3] = np.rint(pixels[..., :3] * alpha)
    options = {"photometric": "rgb", "extrasamples": ["assocalpha"], "byteorder": order, "compression": compression}
    tifffile.imwrite(tmp_path / "a.tif", stored, **options)
    read = read_ldr(tmp_path / "a.tif")
    assert has_16_bits(tmp_path / "a.tif") and read.alpha is not None
    np.testing.assert_allclose(read.alpha, alpha[..., 0], atol=1e-6)
    assert np.abs(read.pixels.astype(int) - pixels[..., :3] * (alpha > 0)).max() <= 3  # Of a quarter of the range


def test_grey_tiffs_of_16_bits_whose_white_is_0_or_that_hold_12(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    grey = RNG.integers(0, 4096, (12, 16), dtype=np.uint16)
    grey[0, :2] = 0, 4095
    tifffile.imwrite(tmp_path / "white.tif", grey << 4, photometric="miniswhite")
    np.testing.assert_array_equal(read_ldr(tmp_path / "white.tif").pixels[..., 0], 65535 - (grey << 4))
    pytest.importorskip("imagecodecs")
    tifffile.imwrite(tmp_path / "packed.tif", grey, photometric="minisblack", bitspersample=12)
    read = read_ldr(tmp_path / "packed.tif").pixels
    assert read.min() == 0 and read.max() == 65535
    np.testing.assert_allclose(read[..., 1], grey * (65535 / 4095), atol=0.51)


def test_planes_without_strips_are_named_by_their_channel(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    options = {"photometric": "rgb", "planarconfig": "separate"}
    tifffile.imwrite(tmp_path / "a.tif", RNG.integers(0, 65536, (3, 12, 16), dtype=np.uint16), byteorder="<", **options)
    data = (tmp_path / "a.tif").read_bytes()
    changed = data.replace(struct.pack("<HHI", 273, 4, 3), struct.pack("<HHI", 273, 4, 1))
    assert changed != data, "tifffile states three places of strips"
    (tmp_path / "a.tif").write_bytes(changed)
    with pytest.raises(InputError, match="cannot be decoded .the strips of channel 1 are damaged."):
        read_ldr(tmp_path / "a.tif")


@pytest.mark.parametrize("stored, words", [
    (np.zeros((8, 8, 5), np.uint16), "5 channels of 16 bits .compression 1., .*; export it as RGB or grey"),
    (np.zeros((8, 8, 3), np.uint32), "3 channels of 32 bits"),
    (np.ones((8, 8, 3), np.float32), "floats, .*; export it with 16 bits, or as OpenEXR"),
])  # fmt: skip
def test_tiffs_that_pillow_does_not_read_are_described(tmp_path, stored, words):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb")
    with pytest.raises(InputError, match=f"is a TIFF of {words}"):
        read_ldr(tmp_path / "a.tif")
