"""RAW files made in memory: a DNG of a Bayer sensor (Adobe's DNG specification 1.4)."""

import struct
from pathlib import Path

import numpy as np

TO_CAMERA = np.array([[0.9, -0.2, -0.1], [-0.4, 1.2, 0.2], [-0.1, 0.2, 0.6]])
"""XYZ to the sensor's colors."""


def write_dng(
    path: Path, light: np.ndarray, *, black=512, white=15000, balance=(0.5, 1.0, 0.7), seconds=1 / 60,
    to_camera=TO_CAMERA, stated=None, maker=None,
) -> None:  # fmt: skip
    """light: [H, W, 3] of even size in the sensor's colors, 1 at the white level, mosaiced as RGGB. balance: what a
    neutral surface gives in each channel. to_camera: as TO_CAMERA. stated: the white level that the file states.
    maker: make and model; the file then says nothing that only DNG says, as those of cameras do."""
    mosaic = np.empty(light.shape[:2])
    for (row, column), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        mosaic[row::2, column::2] = light[row::2, column::2, channel]
    stored = np.rint(black + np.clip(mosaic, 0, 1) * (white - black)).astype("<u2")
    height, width = stored.shape

    def rationals(values, signed=False):
        numbers = [round(float(v) * 10000) for v in np.ravel(values)]
        return (10 if signed else 5), len(numbers), b"".join(struct.pack("<ii", n, 10000) for n in numbers)

    def shorts(*values):
        return 3, len(values), struct.pack(f"<{len(values)}H", *values)

    def longs(*values):
        return 4, len(values), struct.pack(f"<{len(values)}I", *values)

    def text(value):
        return 2, len(value) + 1, value.encode() + b"\0"

    tags = {
        254: longs(0), 256: longs(width), 257: longs(height), 258: shorts(16), 259: shorts(1), 262: shorts(32803),
        271: text("Test"), 272: text("Sensor"), 273: longs(0), 274: shorts(1), 277: shorts(1), 278: longs(height),
        279: longs(stored.nbytes), 33421: shorts(2, 2), 33422: (1, 4, bytes([0, 1, 1, 2])),
        33434: (5, 1, struct.pack("<II", round(seconds * 1e6), 10**6)), 34855: shorts(100),
        50706: (1, 4, bytes([1, 4, 0, 0])), 50708: text("Test Sensor"), 50714: longs(black),
        50717: longs(stated or white), 50721: rationals(to_camera, True), 50728: rationals(balance), 50778: shorts(21),
    }  # fmt: skip
    if maker is not None:
        tags = {tag: value for tag, value in tags.items() if tag < 50000}
        tags |= {271: text(maker[0]), 272: text(maker[1])}
    offset = 8 + 2 + 12 * len(tags) + 4
    entries, blobs = b"", b""
    for tag, (kind, count, data) in sorted(tags.items()):
        if len(data) > 4:
            place, blobs = offset + len(blobs), blobs + data + b"\0" * (len(data) % 2)
            data = struct.pack("<I", place)
        elif tag == 273:
            data = b"STRP"
        entries += struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\0")
    entries = entries.replace(b"STRP", struct.pack("<I", offset + len(blobs)))
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + struct.pack("<I", 0)
    path.write_bytes(head + blobs + stored.tobytes())
