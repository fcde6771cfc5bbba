"""Photos, gain maps, color profiles and DNG opcodes that were made to do harm."""

import struct
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.make_scenes import pattern
from tests.scene.color.test_encoding import icc_profile
from tests.scene.images.gain_map_files import iso_metadata, write_heif_pair, write_jpeg_pair, xmp_segment
from tests.scene.raw.dng_files import area, gain_map, longs, opcodes, shorts, write_tagged_dng

from .hostile import MARKUP, SHORT, gif_named, heic, patched, photo, png, scripts_of, tried

pytestmark = pytest.mark.trial


def pair(path: Path, segment, size=(24, 16), gain=(12, 8)) -> None:
    write_jpeg_pair(path, pattern(*size), pattern(*gain)[..., 0], [segment])


def iso(**options):
    return 0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + iso_metadata(options.pop("maximum", 2.5), **options)


def hdrgm(**fields):
    return xmp_segment({"Version": "1.0", "GainMapMax": "2.5", "HDRCapacityMax": "2.5"} | fields)


def heif_pair(path: Path, **options) -> None:
    files = heic(path.with_name("b.heic")), heic(path.with_name("g.heic"), pattern(12, 8))
    write_heif_pair(path, *files, **options)
    for file in files:
        file.unlink()


PHOTOS = {
    "size of 2^32.heic": lambda path: patched(heic(path), b"ispe", b"\xff" * 8, 8),
    "size of none.heic": lambda path: patched(heic(path), b"ispe", bytes(8), 8),
    "cut.heic": lambda path: path.write_bytes(heic(path).read_bytes()[:300]),
    "zeros.heic": lambda path: path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(5000)),
    "brand alone.heic": lambda path: path.write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"),
    "a gif.heic": gif_named,
    "primary of none.heic": lambda path: patched(heic(path), b"pitm", b"\xff\xff", 8),
    "items of many.heic": lambda path: patched(heic(path), b"iloc", b"\xff\xff", 10),
    "meta of 4 GiB.heic": lambda path: patched(heic(path), b"meta", b"\xff\xff\xff\xff", -4),
    "a text.heic": lambda path: path.write_text("heic " * 100),
    "avif named heic.heic": lambda path: Image.fromarray(pattern(24, 16)).save(path, "AVIF"),
    "bright.jpg": partial(pair, segment=iso(maximum=400)),
    "gain of a bomb.jpg": partial(pair, segment=iso(), gain=(3000, 2000)),
    "no channels.jpg": partial(pair, segment=(0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + bytes(9))),
    "fractions by 0.jpg": partial(
        pair, segment=(0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + struct.pack(">HHB", 0, 0, 0) + bytes(80))
    ),
    "nan.jpg": partial(pair, segment=hdrgm(GainMapMax="nan")),
    "markup.jpg": partial(pair, segment=hdrgm(GainMapMax="&lt;script&gt;", Gamma="\x1b[2J")),
    "metadata that repeat.jpg": lambda path: pair(
        path, (0xFFE1, b"http://ns.adobe.com/xap/1.0/\0" + b"<hdrgm:Gamma>" * 4900)
    ),
    "apple without a note.jpg": partial(pair, segment=xmp_segment({"HDRGainMapVersion": "1"}, "HDRGainMap", "x")),
    "headroom of 1e308.jpg": partial(pair, segment=xmp_segment({"HDRGainMapHeadroom": "1e308"}, "HDRGainMap", "x")),
    "map of itself.heic": lambda path: (
        heif_pair(path, iso=iso_metadata(2.5)),
        patched(path, b"dimg", struct.pack(">4H", 3, 2, 1, 3), 4),
    ),
    "map of nothing.heic": lambda path: (
        heif_pair(path, iso=iso_metadata(2.5)),
        patched(path, b"dimg", struct.pack(">4H", 3, 2, 1, 99), 4),
    ),
    "metadata of 0.heic": partial(heif_pair, iso=b""),
    "apple of nothing.heic": partial(heif_pair, apple_xmp=b""),
    "xmp that repeats.heic": partial(heif_pair, apple_xmp=b"HDRGainMap:HDRGainMapHeadroom=" * 100_000),
}
PROFILES = {
    "nothing": b"",
    "zeros": bytes(5000),
    "cut": icc_profile("Display P3")[:200],
    "tags of many": icc_profile("Display P3")[:128] + b"\xff" * 4 + bytes(400),
    "curve of 2^32": icc_profile("sRGB", curve=b"curv\0\0\0\0\xff\xff\xff\xff\0\0"),
    "gamma 65535": icc_profile("sRGB", gamma=32767.0),
    "falling": icc_profile("sRGB", curve=b"curv\0\0\0\0\0\0\0\2\xff\xff\0\0"),
    "markup": icc_profile("Display P3", name=MARKUP),
    "escape": icc_profile("Display P3", name="\x1b[2J\nsehdr-warp: done"),
    "long name": icc_profile("Display P3", name="n" * 60_000),
    "place outside": icc_profile("Display P3").replace(b"rXYZ\0\0", b"rXYZ\xff\xff"),
    "no primaries": icc_profile("Display P3").replace(b"rXYZ", b"xxxx"),
}


def profiled(path: Path, profile: bytes) -> None:
    Image.fromarray(pattern(24, 16)).save(path, icc_profile=profile)


PHOTOS |= {f"profile: {name}.png": partial(profiled, profile=profile) for name, profile in PROFILES.items()}
PHOTOS |= {
    "size of 2^31.png": partial(png, size=(2**31 - 1, 2**31 - 1)),
    "size of a line.png": partial(png, size=(2**31 - 1, 1)),
    "cicp of none.png": lambda path: png(path, (b"cICP", b"\xff\xff\0\1")),
    "gamma 0.png": lambda path: png(path, (b"gAMA", bytes(4))),
    "text that grows.png": lambda path: png(path, (b"zTXt", b"x\0\0" + zlib.compress(bytes(100_000_000)))),
    "profile that grows.png": lambda path: png(path, (b"iCCP", b"x\0\0" + zlib.compress(bytes(200_000_000)))),
    "exif of itself.png": lambda path: png(
        path, (b"eXIf", b"MM\0*\0\0\0\x08\0\1\x87\x69\0\4\0\0\0\1\0\0\0\x08\0\0\0\0")
    ),
}


@pytest.mark.parametrize("name", PHOTOS)
def test_photos_that_were_made(space, name):
    """A photo that is not good is left out and named, or refused; its colors count as sRGB."""
    path = photo(space, Path(name).suffix)
    PHOTOS[name](path)
    tried(space, SHORT.replace(" -q", ""))
    if (space / "new" / "run.json").exists():
        tried(space, "report new --out seen --device cpu", codes=(0,))
        assert all(scripts_of(page.read_text()) == [] for page in (space / "seen").glob("*.html"))


SIZE = (16, 24)
OPCODES = {
    "list of 2^32": {51009: (7, 4, b"\xff" * 4)},
    "length of 2^32": {51009: (7, 20, struct.pack(">5I", 1, 9, 0, 0, 2**32 - 1))},
    "map of 2^31 rows": {51009: opcodes((9, area(SIZE) + struct.pack(">2I", 2**31, 2**31) + bytes(40)))},
    "map of none": {51009: opcodes((9, area(SIZE) + struct.pack(">2I", 0, 0) + bytes(40)))},
    "area outside": {51009: opcodes(gain_map(np.ones((3, 3)), (9999, 9999), 500, 500))},
    "pitch 0": {51009: opcodes(gain_map(np.ones((3, 3)), SIZE, pitch=0))},
    "gains of nan": {51009: opcodes(gain_map(np.full((3, 3), np.nan), SIZE))},
    "rows of others": {51009: opcodes((12, area(SIZE) + struct.pack(">I", 9) + bytes(36)))},
    "polynomial of 99": {51009: opcodes((8, area(SIZE) + struct.pack(">I", 99) + bytes(800)))},
    "table of 2^32": {51009: opcodes((7, area(SIZE) + b"\xff" * 4))},
    "pixels of 2^32": {51008: opcodes((5, struct.pack(">3I", 0, 2**32 - 1, 2**32 - 1)))},
    "pixels outside": {51008: opcodes((5, struct.pack(">3I", 0, 1, 0) + struct.pack(">2I", 2**31, 2**31)))},
    "lens of nan": {51022: opcodes((1, struct.pack(">I8d", 1, *[float("nan")] * 8)))},
    "lens of 1e300": {51022: opcodes((1, struct.pack(">I8d", 1, 1e300, 1e300, 0, 0, 0, 0, 0.5, 0.5)))},
    "planes of 2^32": {51022: opcodes((1, b"\xff" * 4 + bytes(64)))},
    "a thousand maps": {51009: opcodes(*[gain_map(np.ones((3, 3)), SIZE)] * 1000)},
    "orientation 99": {274: shorts(99)},
    "strips outside": {273: longs(2**31), 279: longs(2**31)},
    "crop of none": {50720: longs(0, 0)},
}


@pytest.mark.parametrize("name", OPCODES)
def test_opcodes_of_dng(space, name):
    pytest.importorskip("rawpy")
    path = photo(space, ".dng")
    write_tagged_dng(path, np.full(SIZE, 9000, np.uint16), OPCODES[name])
    tried(space, "train photos --out new --preset demo --iterations 2 --device cpu")
    tried(space, "train photos --out new --preset demo --response linear --iterations 2 --device cpu --overwrite")
