"""Sets of photos that were made to do harm: places, links, masks, cameras, truth, copies."""

import json
import os
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.output.images.exr import rgb_channels
from sehdr_warp.output.images.exr import write_exr as write_channels
from tests.make_scenes import pattern, write_colmap

from .hostile import EITHER, MARKUP, SHORT, gif_named, heic, link, png, put, tried

pytestmark = pytest.mark.trial


def write_exr(path: Path, values: np.ndarray) -> None:
    write_channels(path, rgb_channels(values))


TRAIN_SET = SHORT.replace(" -q", "")
EARTH = 6.371e6


def exif_of_place(table: dict[int, tuple[int, int, bytes]]) -> bytes:
    """EXIF of a place: type, count and bytes of each of its tags."""
    head = b"II*\0\x08\0\0\0" + struct.pack("<HHHIII", 1, 0x8825, 4, 1, 26, 0)
    entries, data, start = b"", b"", 26 + 2 + 12 * len(table) + 4
    for tag, (kind, count, value) in sorted(table.items()):
        place = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack("<I", start + len(data))
        entries += struct.pack("<HHI", tag, kind, count) + place
        data += value if len(value) > 4 else b""
    return b"Exif\0\0" + head + struct.pack("<H", len(table)) + entries + bytes(4) + data


def doubles(*values: float) -> tuple[int, int, bytes]:
    return 12, len(values), struct.pack(f"<{len(values)}d", *values)


def place_photos(photos: Path, tags: dict[int, tuple[int, int, bytes]], scale: float = 10.0) -> None:
    """States a place in each photo, by its camera: `scale` meters a unit, and tags of EXIF that are others."""
    for frame in json.loads((photos / "transforms.json").read_text())["frames"]:
        path = photos / f"{frame['file_path'].removesuffix('.png')}.png"
        x, y, z = (scale * row[3] for row in frame["transform_matrix"][:3])
        table = {1: (2, 2, b"N\0" if y >= 0 else b"S\0"), 2: doubles(abs(np.degrees(y / EARTH)), 0, 0)}
        table |= {3: (2, 2, b"E\0" if x >= 0 else b"W\0"), 4: doubles(abs(np.degrees(x / EARTH)), 0, 0)}
        table |= {5: (1, 1, b"\0"), 6: doubles(z)}
        image = Image.open(path)
        image.load()
        image.save(path, exif=exif_of_place(table | tags))


PLACES = {
    "as they are": {},
    "altitude 1e308": {6: doubles(1e308)},
    "altitude -1e308": {6: doubles(-1e308)},
    "altitude nan": {6: doubles(float("nan"))},
    "altitude by 0": {6: (5, 1, bytes(8))},
    "altitude of a text": {6: (2, len(MARKUP), MARKUP.encode())},
    "latitude 91": {2: doubles(91, 0, 0)},
    "latitude of many": {2: doubles(*[1.0] * 9999)},
    "latitude of texts": {2: (2, 6, b"x,y,z\0")},
    "count of 2^32": {2: (12, 2**32 - 1, bytes(24))},
    "references of zeros": {1: (2, 5000, bytes(5000)), 3: (1, 1, b"\xff")},
    "all in one place": {},
    "a planet apart": {},
    "an atom apart": {},
}
SCALES = {"all in one place": 0.0, "a planet apart": 2.2e6, "an atom apart": 1e-8}


@pytest.mark.parametrize("name", PLACES)
def test_places_of_photos(space, name):
    """Whatever a photo says of its place, a run that was trained is one that can be read."""
    place_photos(space / "photos", PLACES[name], SCALES.get(name, 10.0))
    tried(space, TRAIN_SET, codes=(0,))
    tried(space, "render new --out seen --device cpu", codes=(0,))


LAYOUTS = ("transforms", "colmap")
LINKS = {
    "masks of the disk": ("masks", "/"),
    "mask of the disk": ("mask", "/"),
    "old masks of the disk": ("old_masks", "/"),
    "segments above": ("segmentation", "../elsewhere"),
    "truth of the disk": ("hdr", "/"),
    "truth above": ("hdr", "../elsewhere"),
    "exr of processes": ("exr", "/proc"),
    "a folder of the disk": ("other", "/"),
    "sparse of the disk": ("sparse2", "/"),
    "one mask above": ("mask.png", "../elsewhere/secret.png"),
    "one mask of a device": ("mask.png", "/dev/zero"),
    "times of a device": ("exposures.json", "/dev/zero"),
    "itself": ("masks/again", ".."),
    "a photo that leads out": ("images/r_2.png", "../../elsewhere/secret.png"),
    "a photo that leads to itself": ("images/r_2.png", "r_2.png"),
    "a mask that leads out": ("masks/r_2.png", "../../elsewhere/secret.png"),
    "cameras that lead out": ("transforms.json", "../elsewhere/secret.json"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", LINKS)
def test_links_that_lead_out_of_a_set(space, name, layout):
    """Files outside are neither searched nor read: the whole disk would take minutes."""
    if layout == "colmap":
        pytest.importorskip("pycolmap")
        write_colmap(space / "set", 4, size=(24, 16), params=(20.0, 21.0, 12.0, 8.0))
    else:
        shutil.copytree(space / "photos", space / "set", dirs_exist_ok=True)
    (space / "elsewhere").mkdir()
    for stem in ("000", "r_0", "secret"):
        write_exr(space / "elsewhere" / f"{stem}.exr", np.full((16, 24, 3), 3.0, np.float32))
        Image.new("L", (24, 16), 255).save(space / "elsewhere" / f"{stem}.png")
    (space / "elsewhere" / "secret.json").write_text('{"secret": 1}')
    link(f"set/{LINKS[name][0]}", LINKS[name][1])(space)

    def watch(event, arguments):
        if event == "open" and isinstance(arguments[0], str | bytes):
            place = os.path.realpath(os.fsdecode(arguments[0]))
            if place.startswith(str(space / "elsewhere")) or place in ("/dev/zero", "/etc/passwd"):
                os.write(2, f"STARTED to open {place}\n".encode())

    ended = tried(space, TRAIN_SET.replace("photos", "set"), seconds=100, prepare=lambda: sys.addaudithook(watch))
    assert "secret" not in ended.err.replace("mask.png", "")


def many(photos: Path) -> None:
    for suffix in ("jpg", "tif", "webp", "avif", "bmp"):
        for number in range(40):
            (photos / "images" / f"r_{number}.{suffix}").write_bytes(b"\xff\xd8\xff" * 50)


COMMON = {
    "of 2^31": lambda photos: png(photos / "mask.png", size=(2**31 - 1, 2**31 - 1)),
    "a text": lambda photos: (photos / "mask.png").write_text("mask"),
    "empty": lambda photos: (photos / "mask.png").touch(),
    "a folder": lambda photos: (photos / "mask.png").mkdir(),
    "a pipe": lambda photos: os.mkfifo(photos / "mask.png"),
    "a gif": lambda photos: gif_named(photos / "mask.png"),
    "cut": lambda photos: (photos / "mask.png").write_bytes((photos / "images" / "r_0.png").read_bytes()[:60]),
    "of nothing": lambda photos: Image.new("L", (24, 16), 0).save(photos / "camera_mask.png"),
    "of one pixel": lambda photos: Image.new("L", (1, 1), 255).save(photos / "mask.png"),
    "of names that repeat": lambda photos: [
        (photos / f"{name}{suffix}").write_text("x")
        for name in ("mask", "camera_mask", "MASK")
        for suffix in (".png", ".jpg", ".PNG", ".webp")
    ],
    "copies that are damaged": many,
    "a pipe beside photos": lambda photos: os.mkfifo(photos / "images" / "r_9.mov"),
    "folders of a thousand": lambda photos: [
        (photos / "images" / f"d{n}" / "mask").mkdir(parents=True) for n in range(1000)
    ],
    "a deep folder": lambda photos: (photos / "images" / "/".join(["masks"] * 200)).mkdir(parents=True),
    "a name of markup": lambda photos: (photos / "images" / MARKUP.replace("/", "_")).write_text("x"),
    "a name that commands": lambda photos: (photos / "images" / "a\x1b[2J.mov").write_text("x"),
}


@pytest.mark.parametrize("name", COMMON)
def test_masks_of_all_photos_and_files_beside_them(space, name):
    COMMON[name](space / "photos")
    tried(space, TRAIN_SET)


TRUTHS = {
    "of another size": lambda path: write_exr(path, np.ones((9, 9, 3), np.float32)),
    "of 1e38": lambda path: write_exr(path, np.full((16, 16, 3), 3e38, np.float32)),
    "below 0": lambda path: write_exr(path, np.full((16, 16, 3), -5.0, np.float32)),
    "a text": lambda path: path.write_text("exr"),
    "a pipe": lambda path: os.mkfifo(path),
    "a folder": lambda path: path.mkdir(),
    "of a device": lambda path: path.symlink_to("/dev/zero"),
    "cut": lambda path: path.write_bytes(b"\x76\x2f\x31\x01\x02\0\0\0" + bytes(300)),
    "of 10,000 names": lambda path: [path.with_name(f"x{number}.exr").touch() for number in range(10_000)],
}


@pytest.mark.parametrize("name", TRUTHS)
def test_pictures_that_are_scored(space, name):
    (space / "theirs").mkdir()
    for number in range(6):
        write_exr(space / "theirs" / f"r_{number}.exr", np.ones((16, 16, 3), np.float32))
    path = space / "theirs" / "r_2.exr"
    path.unlink()
    TRUTHS[name](path)
    tried(space, "eval theirs --truth truth --json seen.json", seconds=100)


def with_copy(make):
    def beside(photos: Path) -> None:
        make(photos / "images" / "r_2.jpg")

    return beside


BESIDE = {
    "a jpeg of 2^16": with_copy(lambda path: path.write_bytes(
        b"\xff\xd8\xff\xc0\0\x11\x08\xff\xff\xff\xff\3\1\x22\0\2\x11\1\3\x11\1" + bytes(64))),
    "a pipe": with_copy(os.mkfifo),
    "a link to itself": with_copy(lambda path: path.symlink_to(path.name)),
    "a heic": with_copy(lambda path: heic(path.with_suffix(".heic"))),
    "the same": with_copy(lambda path: Image.fromarray(pattern(24, 16, seed=2)).save(path)),
}  # fmt: skip


@pytest.mark.parametrize("name", BESIDE)
def test_copies_of_photos(space, name):
    (space / "photos" / "transforms.json").unlink()
    BESIDE[name](space / "photos")
    tried(space, TRAIN_SET, codes=(1,), seconds=100)


@pytest.mark.parametrize("name", ["transforms.json", "exposures.json", "images/r_1.png"])
@pytest.mark.parametrize("kind", ["fifo", "zero", "folder"])
def test_kinds_of_files_of_a_set(space, name, kind):
    put(space / "photos" / name, kind)
    tried(space, SHORT, EITHER if name.startswith("images") else (1,))
