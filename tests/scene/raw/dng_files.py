"""DNG files with any tags, made in memory (Adobe's DNG specification 1.7)."""

import io
import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from sehdr_warp.response import response_by_name
from sehdr_warp.scene.raw.decode import read_raw
from tests.output.helpers import camera

TO_CAMERA = np.array([[0.9, -0.2, -0.1], [-0.4, 1.2, 0.2], [-0.1, 0.2, 0.6]])  # XYZ to the sensor's colors
BAYER = np.array([[0, 1], [1, 2]])
Tag = tuple[int, int, bytes]


def shorts(*values: int) -> Tag:
    return 3, len(values), struct.pack(f"<{len(values)}H", *values)


def longs(*values: int) -> Tag:
    return 4, len(values), struct.pack(f"<{len(values)}I", *values)


def rationals(*values: float) -> Tag:
    numbers = b"".join(struct.pack("<ii", round(value * 10000), 10000) for value in values)
    return (10 if min(values) < 0 else 5), len(values), numbers


def opcodes(*each: tuple[int, bytes], optional: bool = False) -> Tag:
    """An opcode list of (number, parameters)."""
    bodies = (struct.pack(">4I", n, 0x01030000, int(optional), len(body)) + body for n, body in each)
    data = struct.pack(">I", len(each)) + b"".join(bodies)
    return 7, len(data), data


def area(size: tuple[int, int], top=0, left=0, pitch=1, plane=0, planes=1) -> bytes:
    return struct.pack(">8I", top, left, *size, plane, planes, pitch, pitch)


def gain_map(
    gains: np.ndarray, size: tuple[int, int], top: int = 0, left: int = 0, pitch: int = 2
) -> tuple[int, bytes]:
    """A GainMap over the whole picture. gains: [rows, columns]."""
    rows, columns = gains.shape
    spacing = struct.pack(">4d", 1 / (rows - 1), 1 / (columns - 1), 0, 0)
    grid = struct.pack(">2I", rows, columns) + spacing + struct.pack(">I", 1) + gains.astype(">f4").tobytes()
    return 9, area(size, top, left, pitch) + grid


def write_tagged_dng(
    path: Path, stored: np.ndarray, tags: dict[int, Tag | None] | None = None, pattern=BAYER,
    pieces: list[bytes] | None = None,
) -> None:  # fmt: skip
    """stored: [H, W] of a color filter or [H, W, 3] of linear raw; uint16 or float32. tags: beside or in place of the
    usual ones: black level 0, white level 65535, the top left pixel first; None takes one away. pieces: compressed
    strips or tiles, in place of the samples."""
    height, width = stored.shape[:2]
    samples = 1 if stored.ndim == 2 else stored.shape[2]
    pieces = [stored.astype(stored.dtype.newbyteorder("<")).tobytes()] if pieces is None else pieces
    lengths = [len(piece) for piece in pieces]
    all_tags = {
        254: longs(0), 256: longs(width), 257: longs(height), 258: shorts(*[8 * stored.dtype.itemsize] * samples),
        259: shorts(1), 262: shorts(32803 if samples == 1 else 34892), 271: (2, 5, b"Test\0"), 272: (2, 7, b"Sensor\0"),
        274: shorts(1), 277: shorts(samples), 278: longs(height), 284: shorts(1),
        33434: rationals(0.01), 34855: shorts(100), 50706: (1, 4, bytes([1, 4, 0, 0])), 50708: (2, 5, b"Test\0"),
        50714: longs(0), 50717: longs(*[65535] * samples), 50721: rationals(*TO_CAMERA.ravel()),
        50728: rationals(0.5, 1.0, 0.7), 50778: shorts(21),
    }  # fmt: skip
    if samples == 1:
        all_tags[33421] = shorts(*pattern.shape)
        all_tags[33422] = 1, pattern.size, bytes(pattern.ravel().tolist())
    if stored.dtype.kind == "f":
        all_tags[339] = shorts(*[3] * samples)
    all_tags = {tag: value for tag, value in (all_tags | (tags or {})).items() if value is not None}
    place_tag, length_tag = (324, 325) if 322 in all_tags else (273, 279)
    all_tags |= {place_tag: longs(*[0] * len(pieces)), length_tag: longs(*lengths)}
    start, blobs, entries = 8 + 2 + 12 * len(all_tags) + 4, b"", b""
    room = sum(len(value) + len(value) % 2 for _, _, value in all_tags.values() if len(value) > 4)
    all_tags[place_tag] = longs(*(start + room + sum(lengths[:i]) for i in range(len(pieces))))
    for tag, (kind, count, value) in sorted(all_tags.items()):
        if len(value) > 4:
            place, blobs = start + len(blobs), blobs + value + b"\0" * (len(value) % 2)
            value = struct.pack("<I", place)
        entries += struct.pack("<HHI", tag, kind, count) + value.ljust(4, b"\0")
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(all_tags)) + entries + bytes(4) + blobs + b"".join(pieces))


def write_dng(
    path: Path, light: np.ndarray, *, black=512, white=15000, balance=(0.5, 1.0, 0.7), seconds=1 / 60,
    to_camera=TO_CAMERA, stated=None, maker: tuple[str, str] | None = None,
) -> None:  # fmt: skip
    """light: [H, W, 3] of even size in the sensor's colors, 1 at the white level, mosaiced as RGGB. balance: what a
    neutral surface gives in each channel. to_camera: as TO_CAMERA. stated: the white level that the file states.
    maker: make and model; the file then says nothing that only DNG says, as those of cameras do."""
    stored = np.rint(black + np.clip(mosaic(light), 0, 1) * (white - black)).astype(np.uint16)
    tags: dict[int, Tag | None] = {
        33434: (5, 1, struct.pack("<II", round(seconds * 1e6), 10**6)), 50714: longs(black),
        50717: longs(stated or white), 50721: rationals(*np.ravel(to_camera)), 50728: rationals(*balance),
    }  # fmt: skip
    if maker is not None:
        make, model = ((2, len(name) + 1, name.encode() + b"\0") for name in maker)
        tags |= {271: make, 272: model} | dict.fromkeys((50706, 50708, 50714, 50717, 50721, 50728, 50778))
    write_tagged_dng(path, stored, tags)


def mosaic(light: np.ndarray, pattern=BAYER) -> np.ndarray:
    """[H, W] of light [H, W, 3] through a color filter."""
    height, width = light.shape[:2]
    channels = np.tile(pattern, (-(-height // len(pattern)), -(-width // len(pattern))))[:height, :width]
    return np.take_along_axis(light, channels[..., None], axis=2)[..., 0]


def jpeg_tiles(codes, size):
    """JPEG pictures of codes [H, W, 3], padded to whole tiles of (width, height)."""
    padded = np.pad(codes, ((0, -len(codes) % size[1]), (0, -codes.shape[1] % size[0]), (0, 0)), mode="edge")
    tiles = []
    for top in range(0, len(padded), size[1]):
        for left in range(0, padded.shape[1], size[0]):
            buffer = io.BytesIO()
            tile = Image.fromarray(padded[top : top + size[1], left : left + size[0]])
            tile.save(buffer, "JPEG", quality=100, subsampling=0)
            tiles.append(buffer.getvalue())
    return tiles


TRUTH = np.array([0.1, 0.3, 0.2])
HEIGHT, WIDTH = 96, 128
EVEN = np.broadcast_to(TRUTH, (HEIGHT, WIDTH, 3))
Y, X = np.mgrid[:HEIGHT, :WIDTH]


def light_of(path, oriented=False):
    return response_by_name("srgb").decode(read_raw(path, oriented=oriented).pixels / 65535)


def stored(light, black=512.0, white=15000.0):
    return np.rint(black + light * (white - black)).astype(np.uint16)


LEVELS = {50714: longs(512), 50717: longs(15000)}


def shading():
    """Light that falls to a quarter towards the corners, and the gains that undo it."""
    v, h = np.mgrid[:13, :17]
    gains = 1 + 3 * ((v / 12 - 0.5) ** 2 + (h / 16 - 0.5) ** 2) / 0.5
    return 1 / (1 + 3 * (((Y + 0.5) / HEIGHT - 0.5) ** 2 + ((X + 0.5) / WIDTH - 0.5) ** 2) / 0.5), gains


def picture(seed=0, height=24, width=32):
    """[H, W, 3] smooth light over three decades, as a neutral-free gradient."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / width
    return np.exp(4 * np.sin(3 * x + random.uniform(0, 3)) + 2 * y)[..., None] * random.uniform(0.3, 1, 3)


def posed(folder, write, suffix, count=6):
    """A transforms.json of photos that write(path, index) makes."""
    frames = []
    for i in range(count):
        write(folder / f"{i}{suffix}", i)
        pose = np.linalg.inv(camera(position=(0.3 * i, 0, -3)).world_to_camera) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{i}{suffix}", "transform_matrix": pose.tolist()})
    values = {"w": 32, "h": 24, "fl_x": 40, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values))
    return folder
