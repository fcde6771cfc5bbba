"""Pixels: every format against another library's reading, damage, limits, and exact averages."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image, ImageOps

from sehdr_warp.errors import InputError
from sehdr_warp.scene.images.exif import are_camera_files
from sehdr_warp.scene.images.hdr_files import hdr_size, read_hdr
from sehdr_warp.scene.images.ldr_files import exif_of, has_16_bits, image_sizes, open_image, read_ldr
from sehdr_warp.scene.masks import read_mask
from sehdr_warp.scene.photos import photo_sizes
from tests.make_scenes import png_of

cv2 = pytest.importorskip("cv2")
RNG = np.random.default_rng(1)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.jpg", "a.webp", "a.bmp"])
@pytest.mark.parametrize("channels", [1, 3])
def test_eight_bits(tmp_path, name, channels):
    pixels = RNG.integers(0, 256, (20, 30, channels), dtype=np.uint8)
    Image.fromarray(pixels.squeeze()).save(tmp_path / name, quality=100, lossless=True)
    read = read_ldr(tmp_path / name)
    assert read.levels == 255 and read.alpha is None and image_sizes(tmp_path / name) == ((30, 20), (30, 20))
    np.testing.assert_array_equal(read.pixels, np.asarray(Image.open(tmp_path / name).convert("RGB")))


@pytest.mark.parametrize("name", ["a.png", "a.tif", "raw.tif"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_keep_every_bit(tmp_path, name, channels):
    pixels = RNG.integers(0, 65536, (20, 30, channels), dtype=np.uint16)
    cv2.imwrite(str(tmp_path / name), pixels, [cv2.IMWRITE_TIFF_COMPRESSION, 1] if name == "raw.tif" else [])
    read = read_ldr(tmp_path / name)
    assert read.levels == 65535
    expected = pixels[..., [0, 0, 0]] if channels == 1 else pixels[..., 2::-1]
    np.testing.assert_array_equal(read.pixels, expected)
    if channels == 4:
        np.testing.assert_allclose(read.alpha, pixels[..., 3] / 65535, atol=1e-6)


def test_palette_with_transparency(tmp_path):
    image = Image.new("P", (4, 2))
    image.putpalette([10, 20, 30, 200, 100, 50])
    image.putdata([0, 1, 0, 1, 1, 1, 0, 0])
    image.save(tmp_path / "p.png", transparency=0)
    read = read_ldr(tmp_path / "p.png")
    assert read.pixels[0, 1].tolist() == [200, 100, 50] and read.alpha[0].tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_pillows(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)).save(tmp_path / "o.png", exif=exif)
    expected = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "o.png")))
    np.testing.assert_array_equal(read_ldr(tmp_path / "o.png", oriented=True).pixels, expected)
    assert image_sizes(tmp_path / "o.png")[1] == expected.shape[1::-1]


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n"
RGB = Image.fromarray(RNG.integers(0, 256, (6, 8, 3), dtype=np.uint8))


@pytest.mark.parametrize(
    "kind, message",
    [
        ("EPS", "is not a readable image, which is one of PNG"),
        ("GIF", "is a GIF, which is not read as a photo; export it as RGB or grey"),
        ("PPM", "is not a readable image"),
        ("LAB", "holds CIELAB"),
        ("CMYK", r"holds inks \(CMYK\)"),
        ("1", "holds one bit a pixel"),
        ("F", "holds floating-point values"),
        ("YCbCr", "holds YCbCr, not RGB"),
        ("animation", "holds several pictures"),
        ("pages", "holds several pictures"),
    ],
)
def test_other_formats_and_colors_are_refused_and_no_program_is_started(tmp_path, monkeypatch, kind, message):
    """Whatever the name says. A stand-in on the PATH would tell that Ghostscript was asked for."""
    (tmp_path / "gs").write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    path = tmp_path / "photo.png"
    if kind == "EPS":
        path.write_bytes(EPS)
    elif kind in ("GIF", "PPM"):
        RGB.save(path, format=kind)
    elif kind in ("animation", "pages"):
        RGB.save(path, format="PNG" if kind == "animation" else "TIFF", save_all=True, append_images=[RGB.rotate(180)])
    else:
        image = Image.new("LAB", (8, 6)) if kind == "LAB" else RGB.convert("L").convert(kind)
        image.save(path, format="TIFF")
    for read in (read_ldr, image_sizes):
        with pytest.raises(InputError, match=message):
            read(path)
    assert not (tmp_path / "started").exists()
    if kind == "1":
        assert set(np.unique(read_mask(path))) == {0.0, 1.0}


def test_the_first_picture_of_an_mpo_is_the_photo(tmp_path):
    RGB.save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[RGB.rotate(180)])
    RGB.save(tmp_path / "b.jpg")
    np.testing.assert_array_equal(read_ldr(tmp_path / "a.jpg").pixels, read_ldr(tmp_path / "b.jpg").pixels)


def test_too_many_pixels_are_refused_before_decoding(tmp_path):
    header = struct.pack(">II5B", 60000, 60000, 8, 2, 0, 0, 0)
    (tmp_path / "a.png").write_bytes(png_of((b"IHDR", header), (b"IDAT", b"")))
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 60000\n")
    for read, name in ((read_ldr, "a.png"), (image_sizes, "a.png"), (read_hdr, "a.hdr"), (hdr_size, "a.hdr")):
        with pytest.raises(InputError, match="60000 x 60000"):
            read(tmp_path / name)


def test_photos_made_by_a_camera(tmp_path):
    """JPEGs that state an exposure; neither other JPEGs nor other files, nor a minority of them."""
    tags = Image.Exif()
    tags.get_ifd(0x8769)[0x829D] = 8.0
    picture = Image.fromarray(np.zeros((8, 8, 3), np.uint8))
    picture.save(tmp_path / "camera.JPG", exif=tags)
    picture.save(tmp_path / "plain.jpg")
    picture.save(tmp_path / "screen.png", exif=tags)
    camera, plain, screen = (tmp_path / name for name in ("camera.JPG", "plain.jpg", "screen.png"))
    assert are_camera_files([camera]) and are_camera_files([camera, camera, plain])
    for others in ([plain], [screen], [camera, plain], [None], [tmp_path / "gone.jpg"], []):
        assert not are_camera_files(others)


@pytest.mark.parametrize("behind", [False, True])
def test_exif_of_a_png_is_found_without_its_pixels_or_behind_them(tmp_path, behind):
    exif = Image.Exif()
    exif[0x0112] = 6
    path = tmp_path / "o.png"
    Image.fromarray(RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)).save(path, exif=exif)
    content = path.read_bytes()
    start = content.index(b"eXIf") - 4
    chunk = content[start : start + 12 + int.from_bytes(content[start : start + 4], "big")]
    if behind:
        path.write_bytes(content.replace(chunk, b"")[:-12] + chunk + content[-12:])
    with open_image(path) as image:
        assert exif_of(image)[0x0112] == 6
        assert behind or image.tile, "the pixels were decoded"
    assert image_sizes(path) == ((7, 5), (5, 7))


@pytest.mark.parametrize("interlaced", [False, True])
def test_16_bits_of_a_png_of_grey_and_alpha(tmp_path, interlaced):
    pixels = RNG.integers(0, 65536, (1, 7, 2), dtype=np.uint16)
    # Of one row in seven passes, those that hold a pixel of it start at 0, 4, 2 and 1.
    passes = [pixels[0, 0::8], pixels[0, 4::8], pixels[0, 2::4], pixels[0, 1::2]] if interlaced else [pixels[0]]
    rows = b"".join(b"\0" + part.astype(">u2").tobytes() for part in passes)
    head = struct.pack(">IIBBBBB", 7, 1, 16, 4, 0, 0, interlaced)
    (tmp_path / "a.png").write_bytes(png_of((b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")))
    read = read_ldr(tmp_path / "a.png")
    np.testing.assert_array_equal(read.pixels, np.repeat(pixels[..., :1], 3, 2))
    np.testing.assert_allclose(read.alpha, pixels[..., 1] / 65535, atol=1e-6)
    assert has_16_bits(tmp_path / "a.png")


CONTENTS = {
    "is JPEG XL, which is not read as a photo; export it": b"\xff\x0a" + bytes(50),
    "is JPEG 2000": b"\0\0\0\x0cjP  \r\n\x87\n" + bytes(50),
    "is OpenEXR, which is not read as a photo; name it .exr": b"v/1\x01" + bytes(50),
    "is a Git LFS pointer, .*; fetch it with `git lfs pull`": b"version https://git-lfs.github.com/spec/v1",
    "is a web page, .*; download the photo again": b"<!DOCTYPE html><html></html>",
    "is JPEG XR": b"II\xbc\1" + bytes(50),
    "is a lossless JPEG": b"\xff\xd8\xff\xc3\0\x0b\x10\0\x10\0\x10\1\1\x11\0",
    "is a JPEG of 12 bits": b"\xff\xd8\xff\xe0\0\x04\0\0\xff\xc1\0\x11\x0c\0\x10\0\x10\x03",
}


@pytest.mark.parametrize("words", CONTENTS)
def test_what_a_file_is_that_is_not_read(tmp_path, words):
    (tmp_path / "a.jpg").write_bytes(CONTENTS[words])
    for name, expected in (("a.jpg", words), ("gone.jpg", "image file not found")):
        with pytest.raises(InputError, match=f"{name}: {expected}"):
            read_ldr(tmp_path / name)


@pytest.mark.parametrize("name", ["a.dng", "a.ARW", "a.exr", "a.hdr"])
def test_photos_of_codes_under_other_names_are_named(tmp_path, name):
    RGB.save(tmp_path / name, format="JPEG")
    with pytest.raises(InputError, match="is a JPEG photo, not what its name says; name it .jpg"):
        photo_sizes(tmp_path / name)
