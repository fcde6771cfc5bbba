"""DNG files as phones, drones and converters write them: each from light that the test knows."""

import struct

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene.raw.decode import read_header, read_raw

from .dng_files import (
    EVEN,
    HEIGHT,
    LEVELS,
    WIDTH,
    X,
    Y,
    area,
    jpeg_tiles,
    light_of,
    longs,
    mosaic,
    opcodes,
    shorts,
    stored,
    write_tagged_dng,
)

pytest.importorskip("rawpy")


@pytest.mark.parametrize("size", [(80, 40), (WIDTH, HEIGHT)])
@pytest.mark.parametrize("meaning", ["polynomial", "table", "linear"])
def test_lossy_compression(tmp_path, size, meaning):
    """The codes' curve is the file's: LibRaw has one of its own for files without an opcode."""
    light = 0.5 + 0.4 * (X / WIDTH - Y / HEIGHT)[..., None] * [1.0, 0.5, 0.8]
    codes = np.rint(255 * (light if meaning == "linear" else np.sqrt(light / 0.95))).astype(np.uint8)
    tags = {258: shorts(8, 8, 8), 259: shorts(34892), 50717: longs(255, 255, 255)}
    tags |= {322: longs(size[0]), 323: longs(size[1])} if size[0] < WIDTH else {278: longs(2**32 - 1)}
    if meaning == "polynomial":
        curves = [(8, area((HEIGHT, WIDTH), plane=c) + struct.pack(">I3d", 2, 0, 0, 0.95)) for c in range(3)]
        tags[51009] = opcodes(*curves)
    if meaning == "table":
        squares = np.rint(0.95 * 65535 * (np.arange(256) / 255) ** 2).astype(int)
        tags |= {50712: shorts(*squares), 50717: longs(65535, 65535, 65535)}
    write_tagged_dng(tmp_path / "a.dng", codes, tags, pieces=jpeg_tiles(codes, size))
    error = np.abs(light_of(tmp_path / "a.dng") - light)
    assert error.max() < 0.03 and error.mean() < 0.005
    assert read_header(tmp_path / "a.dng")[0] == (WIDTH, HEIGHT)


def test_damaged_pictures_of_lossy_files_are_named(tmp_path):
    codes = np.full((HEIGHT, WIDTH, 3), 99, np.uint8)
    tags = {258: shorts(8, 8, 8), 259: shorts(34892), 322: longs(80), 323: longs(40)}
    tiles = jpeg_tiles(codes, (80, 40))
    cases = {
        "cannot be read as RAW": [tiles[0][:300], *tiles[1:]],
        "a JPEG picture in it is damaged .96 x": [*jpeg_tiles(codes[:, :96], (96, 40))[:1], *tiles[1:]],
        "5 tiles, not 6": tiles[:-1],
        "a tile of 2000000 bytes, more than 1067776": [tiles[0].ljust(2_000_000, b"\0"), *tiles[1:]],
        r"its DNG tags cannot be used: tag 324 is \(\)": [],
    }
    for match, pieces in cases.items():
        write_tagged_dng(tmp_path / "a.dng", codes, tags, pieces=pieces)
        with pytest.raises(InputError, match=match):
            read_raw(tmp_path / "a.dng", oriented=False)


def test_what_cannot_be_read_is_named(tmp_path):
    file = tmp_path / "a.dng"

    def refused(match, values=None, tags=None):
        write_tagged_dng(file, stored(mosaic(EVEN)) if values is None else values, LEVELS | (tags or {}))
        with pytest.raises(InputError, match=match):
            read_raw(file, oriented=False)

    refused("compressed as JPEG XL.*convert it with Adobe DNG Converter", tags={259: shorts(52546)})
    refused("compressed as Deflate.*convert it", tags={259: shorts(8)})
    refused("compressed as compression 77.*convert it", tags={259: shorts(77)})
    refused("color filter's samples are compressed with loss", tags={259: shorts(34892)})
    refused("floating-point samples", values=mosaic(EVEN).astype(np.float32), tags={50714: longs(0), 50717: longs(1)})
    refused("demands opcode 99", tags={51009: opcodes((99, b""))})
    refused(r"demands opcode 6 \(TrimBounds\)", tags={51022: opcodes((6, struct.pack(">4I", 8, 8, 64, 96)))})
    refused("list of DNG opcodes is damaged", tags={51009: (7, 6, b"\0\0\0\2xx")})
    refused("DNG opcode 9 is damaged", tags={51009: opcodes((9, b"\0" * 20))})
    refused("white level .* is not above black level", tags={50714: longs(20000)})
    refused("ActiveArea", tags={50829: longs(0, 0, HEIGHT, 2 * WIDTH)})
    refused("one channel", values=np.zeros((HEIGHT, WIDTH), np.uint16), tags={262: shorts(34892)})
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(
        file, stored(EVEN), bigtiff=True, photometric=34892, extratags=[(50706, 1, 4, bytes([1, 7, 0, 0]))]
    )
    with pytest.raises(InputError, match="form of a BigTIFF.*convert it"):
        read_raw(file, oriented=False)
    write_tagged_dng(file, stored(mosaic(EVEN)), LEVELS | {51009: opcodes((99, b""), optional=True)})
    np.testing.assert_allclose(light_of(file), EVEN, rtol=2e-3)
