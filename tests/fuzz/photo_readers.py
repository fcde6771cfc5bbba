"""Small photos, HDR images and clips to damage, and their readers."""

import struct
from pathlib import Path

import numpy as np
from PIL import Image

from sehdr_warp.output.images.exr import Part, write_exr, write_multipart_exr
from sehdr_warp.scene import Camera, Scene, View, look_at
from sehdr_warp.scene.color.encoding import encoding_of
from sehdr_warp.scene.gravity import find_up
from sehdr_warp.scene.images.exif import exif_exposure
from sehdr_warp.scene.images.gain_map import light_of, read_gain_map
from sehdr_warp.scene.images.hdr_files import hdr_size, read_exr_channels, read_hdr
from sehdr_warp.scene.images.ldr_files import open_image
from sehdr_warp.scene.masks import read_mask
from sehdr_warp.scene.photos import photo_sizes, read_photo
from sehdr_warp.scene.raw.decode import color_matrix, read_header
from sehdr_warp.scene.video.decode import codes, decode, open_clip
from sehdr_warp.scene.video.frames import choose_frames
from tests.make_scenes import pattern
from tests.scene.color.test_encoding import icc_profile
from tests.scene.images.gain_map_files import iso_metadata, write_heif_pair, write_jpeg_pair, xmp_segment
from tests.scene.raw.dng_files import (
    area,
    gain_map,
    jpeg_tiles,
    longs,
    mosaic,
    opcodes,
    shorts,
    write_dng,
    write_tagged_dng,
)
from tests.scene.video.clips import pan, write_clip
from tests.trial.test_sets import exif_of_place

from .reader import Reader, each


def make_exr(folder: Path) -> None:
    pixels = np.linspace(0, 3, 8 * 6 * 3, dtype=np.float32).reshape(6, 8, 3)
    channels = {name: pixels[..., i] for i, name in enumerate("RGB")}
    write_exr(folder / "half.exr", channels)
    write_exr(folder / "float.exr", channels, pixel="float")
    write_multipart_exr(folder / "parts.exr", [Part(channels, name="a"), Part(channels, name="b")])


def make_radiance(folder: Path) -> None:
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2.0\n\n-Y 4 +X 9\n"
    row = b"\x02\x02\x00\x09" + (b"\x89\x40" + b"\x89\x50" + b"\x09abcdefghi" + b"\x89\x81")
    (folder / "coded.hdr").write_bytes(header + row * 4)
    (folder / "flat.hdr").write_bytes(header.replace(b"X 9", b"X 3") + bytes(range(120, 168)))


def make_photos(folder: Path) -> None:
    picture = Image.fromarray(pattern(12, 10))
    tags = Image.Exif()
    tags[0x0112] = 6
    tags.get_ifd(0x8769)[33434] = 0.01
    for name in ("a.jpg", "a.png", "a.tif"):
        picture.save(folder / name, exif=tags)
    picture.save(folder / "a.webp")
    picture.convert("RGBA").save(folder / "b.png")
    picture.convert("P").save(folder / "c.png")
    picture.save(folder / "a.bmp")
    Image.fromarray(np.arange(120, dtype=np.uint16).reshape(10, 12)).save(folder / "d.png")


def make_places(folder: Path) -> None:
    """EXIF of places as the photo has it, and as numbers of other types."""
    picture = Image.fromarray(pattern(12, 10))
    rational = struct.pack("<6I", 48, 1, 12, 1, 30, 1)
    table = {1: (2, 2, b"N\0"), 2: (5, 3, rational), 3: (2, 2, b"E\0"), 4: (5, 3, rational), 5: (1, 1, b"\0")}
    for name, altitude in (("a.jpg", (5, 1, struct.pack("<2I", 300, 2))), ("b.jpg", (12, 1, struct.pack("<d", 150.5)))):
        picture.save(folder / name, exif=exif_of_place(table | {6: altitude}))


def read_place(path: Path):
    """Read the place of a photo beside a flight of six photos, of which five state where they were."""
    whole = path.with_name("b.jpg" if path.name == "a.jpg" else "a.jpg")
    views = []
    for number in range(6):
        pose = look_at((number % 3, number // 3, 4.0), (number % 3, number // 3, 0.0), up=(0, 1, 0))
        lens = Camera(12, 10, 10, 10, 6, 5, pose)
        source = path if number % 2 else whole
        views.append(View(str(number), np.zeros((10, 12, 3), np.uint8), lens, 1.0, "train", source=source))
    return find_up(Scene("flight", "photos", tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.float32)))


def make_raw(folder: Path) -> None:
    write_dng(folder / "a.dng", np.linspace(0, 1, 32 * 24 * 3).reshape(24, 32, 3))


def read_upright(path: Path):
    return read_photo(path, oriented=True)


def read_matrix(path: Path):
    return color_matrix([path])


def save_heif(folder: Path, name: str, pixels: np.ndarray, **options) -> Path:
    """A photo as .heic or .avif."""
    image = Image.fromarray(pixels)
    if name.endswith(".avif"):
        image.save(folder / name, quality=90, **options)
    else:
        import pillow_heif

        pillow_heif.from_pillow(image).save(folder / name, quality=90, **options)
    return folder / name


def make_gain_maps(folder: Path) -> None:
    base, gain = pattern(16, 12), pattern(8, 6)[..., 0]
    iso = 0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + iso_metadata(2.5, channels=3)
    write_jpeg_pair(folder / "iso.jpg", base, gain, [iso])
    write_jpeg_pair(folder / "xmp.jpg", base, gain, [xmp_segment({"GainMapMax": "2.5", "HDRCapacityMax": "2.5"})])
    apple = xmp_segment({"HDRGainMapHeadroom": "4"}, "HDRGainMap", "http://ns.apple.com/HDRGainMap/1.0/")
    write_jpeg_pair(folder / "apple.jpg", base, gain, [apple])
    for suffix in (".heic", ".avif"):
        files = [
            save_heif(folder, f"{n}{suffix}", p) for n, p in (("b", base), ("g", np.repeat(gain[..., None], 3, 2)))
        ]
        write_heif_pair(folder / f"iso{suffix}", *files, iso=iso_metadata(2.5))
        if suffix == ".heic":
            write_heif_pair(folder / "apple.heic", *files, apple_xmp=apple[1].partition(b"\0")[2])
        for file in files:
            file.unlink()


def read_light(path: Path):
    pair = read_gain_map(path, oriented=True)
    return None if pair is None else light_of(read_photo(path), pair)


def make_heic(folder: Path) -> None:
    tags = Image.Exif()
    tags[0x0112] = 6
    tags.get_ifd(0x8769)[33434] = 0.01
    for name in ("a.heic", "a.avif"):
        save_heif(folder, name, pattern(16, 12), exif=tags.tobytes())
    import pillow_heif

    deep = np.linspace(0, 65535, 16 * 12 * 3).astype(np.uint16)
    pillow_heif.from_bytes("RGB;16", (16, 12), deep.tobytes()).save(folder / "deep.heic", quality=90)


def make_icc(folder: Path) -> None:
    (folder / "matrix.icc").write_bytes(icc_profile("Display P3"))
    (folder / "gamma.icc").write_bytes(icc_profile("Adobe RGB (1998)", 2.2))
    table = b"curv\0\0\0\0" + struct.pack(">I9H", 9, *range(0, 65536, 8191))
    (folder / "table.icc").write_bytes(icc_profile("sRGB", curve=table))


def read_icc(path: Path):
    """Through a photo that holds it, which is read all the same if the profile is damaged."""
    photo = path.with_suffix(".jpg")
    try:
        Image.fromarray(pattern(8, 6)).save(photo, icc_profile=path.read_bytes())
    except (ValueError, OSError):  # A profile that no JPEG holds
        return None
    pixels = read_photo(photo).pixels
    with open_image(photo) as image:
        encoding = encoding_of(image)
    return encoding.to_linear(pixels) if encoding is not None else None


def make_video(folder: Path) -> None:
    frames = list(pan(12, 48, 64, 4))  # x265 damages memory below 50 pixels.
    for name in ("a.mp4", "a.mkv", "a.avi", "a.mts"):
        write_clip(folder / name, frames, codec="libx264", pixels="yuv420p")
    write_clip(folder / "hlg.mov", frames, tags=(18, 9, 9), pixels="yuv420p10le", rotation=90)
    write_clip(folder / "lossless.mkv", frames, codec="ffv1")


def read_video(path: Path):
    clip = open_clip(path)
    chosen = choose_frames(clip)
    return [codes(frame, clip.color) for _, frame in decode(clip, set(chosen.numbers[:2]))]


def make_dng_opcodes(folder: Path) -> None:
    size, stored = (24, 32), np.full((24, 32), 9000, np.uint16)
    rows = struct.pack(">I", 24) + np.linspace(0.5, 1.5, 24).astype(">f4").tobytes()
    lists = {
        "map": {51009: opcodes(gain_map(np.full((3, 4), 1.5), size))},
        "row": {51009: opcodes((12, area(size) + rows), (8, area(size) + struct.pack(">I2d", 1, 0.05, 0.8)))},
        "bad": {51008: opcodes((5, struct.pack(">3I", 0, 1, 1) + struct.pack(">6I", 4, 6, 2, 3, 4, 5)))},
        "lens": {
            51022: opcodes((3, struct.pack(">7d", 1, 0, 0, 0, 0, 0.5, 0.5)),
                           (1, struct.pack(">I8d", 1, 0.9, 0, 0, 0, 0, 0, 0.5, 0.5)),
                           (14, struct.pack(">I21dI", 1, 1.1, *[0] * 16, 0, 1, 0.5, 0.5, 1)))
        },
    }  # fmt: skip
    for name, tags in lists.items():
        write_tagged_dng(folder / f"{name}.dng", stored, tags)
    codes = np.full((24, 32, 3), 99, np.uint8)
    table = longs(*np.arange(256).tolist())
    tags = {258: shorts(8, 8, 8), 259: shorts(34892), 322: longs(16), 323: longs(16), 50712: table}
    write_tagged_dng(folder / "lossy.dng", codes, tags, pieces=jpeg_tiles(codes, (16, 16)))
    write_tagged_dng(folder / "linear.dng", np.repeat(stored[..., None], 3, 2))
    write_tagged_dng(folder / "mosaic.dng", (mosaic(np.full((24, 32, 3), 0.3)) * 65535).astype(np.uint16))


READERS = {
    "exr": Reader(make_exr, ("*.exr",), each(hdr_size, read_hdr, read_exr_channels)),
    "radiance": Reader(make_radiance, ("*.hdr",), each(read_hdr), cost=0.5),
    "photos": Reader(make_photos, ("*",), each(photo_sizes, read_mask, exif_exposure, read_upright), cost=1.2),
    "places": Reader(make_places, ("*.jpg",), each(read_place), cost=4),
    "raw": Reader(make_raw, ("*",), each(photo_sizes, read_header, read_matrix, read_upright), cost=2),
    "gain-maps": Reader(make_gain_maps, ("*",), each(read_light), cost=1.6),
    "heic": Reader(make_heic, ("*",), each(photo_sizes, exif_exposure, read_upright), cost=0.9),
    "icc": Reader(make_icc, ("*.icc",), each(read_icc), cost=4),
    "video": Reader(make_video, ("*",), each(read_video), cost=150),
    "dng-opcodes": Reader(make_dng_opcodes, ("*",), each(photo_sizes, read_header, read_upright), cost=6),
}
