"""SPZ (Niantic), version 3: display colors in bytes, without a header for anything else.

Stored coordinates are x right, y up, z back; Gaussians here have the axes of PLY, y down and z ahead. Colors end at
1.44 times white. Versions 2 to 4 are read; 4, whose blocks are compressed by Zstandard, needs the extra `spz`.
"""

import gzip
import logging
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import InputError, require_extra
from ..files import atomic_path, read_bytes
from .arrays import MAX_DEGREE, GaussianArrays
from .packing import from_smallest_three, logits, morton_order, smallest_three

log = logging.getLogger(__name__)
_MAGIC, _VERSION = 0x5053474E, 3
_HEADER = struct.Struct("<IIIBBBB")
_STREAMS_AT = 16  # Of version 4: byte that states where the sizes of its streams begin
_MOST_PER_BYTE = 10_000  # Bytes of a stream for each byte of the file: more is a false count
_ANTIALIASED, _EXTENDED = 1, 2  # Flags: of opacity compensation; of extensions behind the Gaussians
_COLOR_SCALE = 0.15  # Of the constant harmonic before it becomes a byte
_MOST_RESIZED = 0.01  # Share of Gaussians whose sizes may change without a warning
_MOST = 50_000_000  # Gaussians of a file that is read
_LARGEST = 2.0**23  # Of a coordinate: 24 bits with a sign
_DAMAGED = "export it again"
_TO_FILE = np.diag([1.0, -1.0, -1.0, 1.0])


def write_spz(path: Path, gaussians: GaussianArrays, overwrite: bool) -> None:
    """Write a .spz file; arguments as in write_gaussians."""
    gaussians = gaussians.transformed(_TO_FILE)
    gaussians = gaussians.rows(morton_order(gaussians.means))
    largest = float(np.abs(gaussians.means).max())
    if largest >= _LARGEST:
        problem = f"holds positions below {_LARGEST:.0f}, and these reach {largest:.4g}"
        raise InputError(path, f"SPZ {problem}", "write another format, or leave out what is far (--crop)")
    fraction = int(np.clip(22 - np.ceil(np.log2(max(largest, 1e-6))), 0, 24))
    fixed = np.rint(gaussians.means.astype(np.float64) * 2.0**fraction).astype("<i4")
    positions = np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    sizes = np.rint((gaussians.log_scales + 10) * 16)
    if (share := ((sizes < 0) | (sizes > 255)).any(axis=1).mean()) > _MOST_RESIZED:
        text = "%s: %.0f %% of the Gaussians are beyond SPZ's sizes, 0.00005 to 380 units; set another --scale"
        log.warning(text, path.name, 100 * share)
    colors = np.rint((gaussians.harmonics[:, 0].astype(np.float64) * _COLOR_SCALE + 0.5) * 255)
    higher = np.rint(gaussians.harmonics[:, 1:].astype(np.float64) * 128 + 128)
    largest_index, others = smallest_three(np.roll(gaussians.unit_quaternions.astype(np.float64), -1, axis=1))
    packed = largest_index.astype(np.uint32)
    for column in others.T:
        size = np.minimum(np.abs(column) * 511 + 0.5, 511).astype(np.uint32)
        packed = (packed << 10) | ((column < 0).astype(np.uint32) << 9) | size
    parts = [
        _HEADER.pack(
            _MAGIC, _VERSION, gaussians.count, gaussians.degree, fraction, _ANTIALIASED * gaussians.antialiased, 0
        ),
        positions.tobytes(),
        np.rint(gaussians.opacities * 255).astype(np.uint8).tobytes(),
        np.clip(colors, 0, 255).astype(np.uint8).tobytes(),
        np.clip(sizes, 0, 255).astype(np.uint8).tobytes(),
        packed.astype("<u4").tobytes(),
        np.clip(higher, 0, 255).astype(np.uint8).tobytes(),
    ]
    with atomic_path(path, overwrite) as temporary:
        temporary.write_bytes(gzip.compress(b"".join(parts), mtime=0))


def read_spz(path: Path) -> GaussianArrays:
    """Read a .spz file of version 2, 3 or 4."""
    data = read_bytes(path)
    unpack = None if data[:4] == struct.pack("<I", _MAGIC) else zlib.decompressobj(wbits=31)
    try:
        header = data[: _HEADER.size] if unpack is None else unpack.decompress(data, _HEADER.size)
        magic, version, count, degree, fraction, flags, streams = _HEADER.unpack(header)
    except (zlib.error, struct.error) as error:
        raise InputError(path, f"is damaged SPZ ({error!s:.80})", _DAMAGED) from None
    if magic == _MAGIC and version not in (2, 3, 4):
        raise InputError(path, f"is SPZ of version {version}", "save it as version 2, 3 or 4, or as PLY")
    if magic == _MAGIC and degree > MAX_DEGREE:
        raise InputError(path, f"has harmonics of degree {degree}", f"export it with degree 0 to {MAX_DEGREE}")
    if magic != _MAGIC or not 0 < count <= _MOST or fraction > 24:
        raise InputError(path, "is not SPZ, or damaged", _DAMAGED)
    coefficients, turn = (degree + 1) ** 2 - 1, 3 if version == 2 else 4
    widths = (9, 1, 3, 3, turn, 3 * coefficients)
    size = count * sum(widths)
    try:
        if version == 4:
            rest = _zstandard_streams(path, data, streams, [count * width for width in widths if width])
        else:
            rest = data[_HEADER.size :] if unpack is None else unpack.decompress(unpack.unconsumed_tail, size)
    except zlib.error as error:
        raise InputError(path, f"is damaged SPZ ({error!s:.80})", _DAMAGED) from None
    if len(rest) < size:
        raise InputError(path, f"ends after {len(rest)} of {size} bytes", _DAMAGED)
    body = np.frombuffer(rest, np.uint8)
    edges = np.cumsum([0, *widths]) * count
    blocks = [body[a:b].reshape(count, -1) for a, b in zip(edges, edges[1:])]  # noqa: RUF007  NumPy's are indices
    positions, alphas, colors, scales, turns, higher = blocks
    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[:, :, 1:] = positions.reshape(count, 3, 3)
    means = (fixed.view("<i4")[:, :, 0] >> 8) / 2.0**fraction
    harmonics = np.zeros((count, coefficients + 1, 3), np.float32)
    harmonics[:, 0] = (colors / 255 - 0.5) / _COLOR_SCALE
    harmonics[:, 1:] = (higher.reshape(count, -1, 3) - 128.0) / 128
    gaussians = GaussianArrays(
        means=means.astype(np.float32),
        log_scales=(scales / 16 - 10).astype(np.float32),
        quaternions=_quaternions(turns, version),
        opacity_logits=logits(alphas[:, 0] / 255),
        harmonics=harmonics,
        color_model="display",
        base_time=1.0,
        antialiased=bool(flags & _ANTIALIASED),
    )
    if flags & _EXTENDED:
        log.warning("%s: its extensions are not read; one of them may state other axes than SPZ's", path)
    return replace(gaussians.transformed(np.linalg.inv(_TO_FILE)), world_matrix=None)


def _zstandard_streams(path: Path, data: bytes, streams: int, sizes: list[int]) -> bytes:
    """Return the `streams` decompressed blocks of a file of version 4 behind each other, of `sizes` bytes.

    Raises:
        InputError: if they do not have these sizes.
        SehdrError: without imagecodecs (the extra `spz`).
    """
    codec = require_extra("imagecodecs", f"{path}: SPZ of version 4 needs imagecodecs", "spz")
    if streams != len(sizes):
        raise InputError(path, f"has {streams} streams instead of {len(sizes)}", _DAMAGED)
    blocks = []
    try:
        (start,) = struct.unpack_from("<I", data, _STREAMS_AT)
        begin = start + 16 * streams
        for index, size in enumerate(sizes):
            packed_size, full_size = struct.unpack_from("<QQ", data, start + 16 * index)
            if full_size != size or size > _MOST_PER_BYTE * len(data):
                raise InputError(path, f"states {full_size} bytes for stream {index}, of {size}", _DAMAGED)
            blocks.append(codec.zstd_decode(data[begin : begin + packed_size], out=size))
            begin += packed_size
    except (struct.error, RuntimeError) as error:
        raise InputError(path, f"is damaged SPZ ({error!s:.80})", _DAMAGED) from None
    return b"".join(blocks)


def _quaternions(turns: np.ndarray, version: int) -> np.ndarray:
    """Return [N, 4] (w x y z) of packed rotations."""
    if version == 2:
        vector = turns / 127.5 - 1
        real = np.sqrt(np.maximum(1 - (vector**2).sum(axis=1), 0))
        return np.concatenate([real[:, None], vector], axis=1).astype(np.float32)
    packed = np.ascontiguousarray(turns).view("<u4")[:, 0]
    fields = [(packed >> shift) & 1023 for shift in (20, 10, 0)]
    others = np.stack([np.where(field >> 9, -1, 1) * (field & 511) / 511 for field in fields], axis=1)
    return np.roll(from_smallest_three((packed >> 30).astype(int), others), 1, axis=1)
