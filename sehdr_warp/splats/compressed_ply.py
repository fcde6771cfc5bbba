"""Compressed PLY (SuperSplat): chunks of 256 Gaussians with 32 bits for each of place, turn, size and color."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import atomic_path
from .arrays import HARMONIC_0, GaussianArrays, degree_of, stated_facts
from .packing import from_smallest_three, logits, morton_order, smallest_three

SUFFIX = ".compressed.ply"
MIP = "SplatRenderMode: mip"  # Comment of Gaussians that are to be rendered with opacity compensation
_CHUNK = 256
_LIMITS = ("x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b")
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BITS = ((21, 11), (11, 10), (0, 11))  # Shift and width of x, y and z
_REACH = 8.0  # Width of the range of higher harmonics, which are bytes
_DAMAGED = "export it again"


def write_compressed_ply(path: Path, gaussians: GaussianArrays, overwrite: bool) -> None:
    """Write a .compressed.ply file; arguments as in write_gaussians."""
    from plyfile import PlyData, PlyElement

    gaussians = gaussians.rows(morton_order(gaussians.means))
    count = gaussians.count
    chunks = -(-count // _CHUNK)
    # The last chunk is filled with copies of the last Gaussian, so that its limits stay.
    filled = np.minimum(np.arange(chunks * _CHUNK), count - 1).reshape(chunks, _CHUNK)
    color = gaussians.harmonics[:, 0].astype(np.float64) * HARMONIC_0 + 0.5
    groups = [gaussians.means.astype(np.float64), np.clip(gaussians.log_scales.astype(np.float64), -20, 20), color]
    limits, units = [], []
    for values in groups:
        inside = values[filled]
        low, high = (inside.min(axis=1).astype(np.float32), inside.max(axis=1).astype(np.float32))
        width = np.where(high - low < 1e-5, 1, high - low)[:, None]
        units.append(np.clip((inside - low[:, None]) / width, 0, 1).reshape(-1, 3)[:count])
        limits.append((low, high))
    table = np.empty(
        chunks, [(f"{end}_{name}", "<f4") for g in range(3) for end in ("min", "max") for name in _names(g)]
    )
    for g, (low, high) in enumerate(limits):
        for i, name in enumerate(_names(g)):
            table[f"min_{name}"], table[f"max_{name}"] = low[:, i], high[:, i]
    largest, others = smallest_three(gaussians.unit_quaternions.astype(np.float64))
    turns = largest.astype(np.uint32)
    for column in others.T:
        turns = (turns << 10) | _unorm(column / 2 + 0.5, 10)
    colors = [*units[2].T, gaussians.opacities]
    packed = np.empty(count, [(name, "<u4") for name in _PACKED])
    for name, unit in zip(("packed_position", "packed_scale"), units[:2], strict=True):
        packed[name] = sum(_unorm(unit[:, i], bits) << shift for i, (shift, bits) in enumerate(_BITS))
    packed["packed_rotation"] = turns
    packed["packed_color"] = sum(_unorm(column, 8) << (24 - 8 * i) for i, column in enumerate(colors))
    elements = [PlyElement.describe(table, "chunk"), PlyElement.describe(packed, "vertex")]
    rest = gaussians.harmonics[:, 1:].swapaxes(1, 2).reshape(count, -1)
    if rest.shape[1]:
        bytes_ = np.clip(np.floor((rest / _REACH + 0.5) * 256), 0, 255).astype(np.uint8)
        higher = np.empty(count, [(f"f_rest_{i}", "u1") for i in range(rest.shape[1])])
        for i, column in enumerate(bytes_.T):
            higher[f"f_rest_{i}"] = column
        elements.append(PlyElement.describe(higher, "sh"))
    with atomic_path(path, overwrite) as temporary, temporary.open("wb") as file:
        PlyData(elements, byte_order="<", comments=header_comments(gaussians)).write(file)


def header_comments(gaussians: GaussianArrays) -> list[str]:
    """Return the comments of a PLY header that state what its properties do not."""
    facts = {"color_model": gaussians.color_model} | {
        name: json.dumps(value, separators=(",", ":")) for name, value in stated_facts(gaussians).items()
    }
    return [*(f"sehdr:{name} {value}" for name, value in facts.items()), *[MIP] * gaussians.antialiased]


def unpack_ply(elements: Any, path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of GaussianArrays that a PlyData with packed vertices holds.

    Raises:
        InputError: If chunks are missing or harmonics do not fit.
    """
    chunk, vertex = elements["chunk"], elements["vertex"]
    count = len(vertex.data)
    index = np.arange(count) // _CHUNK
    if len(chunk.data) * _CHUNK < count:
        raise InputError(path, f"has {len(chunk.data)} chunks for {count} Gaussians", _DAMAGED)

    def in_chunk(unit: np.ndarray, names: tuple[str, ...], prefix: tuple[str, str] = ("min", "max")) -> np.ndarray:
        low, high = (np.stack([np.asarray(chunk[f"{end}_{name}"], np.float64) for name in names], 1) for end in prefix)
        return low[index] + unit * (high - low)[index]

    position, scale, turns, color = (
        np.asarray(vertex[f"packed_{n}"], np.uint32) for n in ("position", "scale", "rotation", "color")
    )
    units = [np.stack([_field(packed, shift, bits) for shift, bits in _BITS], 1) for packed in (position, scale)]
    shades = np.stack([_field(color, shift, 8) for shift in (24, 16, 8, 0)], 1)
    present = {each.name for each in chunk.properties}
    tint = in_chunk(shades[:, :3], _names(2)) if "min_r" in present else shades[:, :3].astype(np.float64)
    others = np.stack([_field(turns, shift, 10) for shift in (20, 10, 0)], 1) * 2 - 1
    constant = (tint - 0.5) / HARMONIC_0
    harmonics = constant[:, None]
    if any(element.name == "sh" for element in elements):
        higher = elements["sh"]
        names = sorted((each.name for each in higher.properties), key=lambda name: int(name.rpartition("_")[2]))
        degree_of(1 + len(names) / 3, path)
        bytes_ = np.stack([np.asarray(higher[name], np.float64) for name in names], 1)
        if len(bytes_) != count:
            raise InputError(path, f"has harmonics of {len(bytes_)} of {count} Gaussians", _DAMAGED)
        values = np.where(bytes_ == 0, 0.0, np.where(bytes_ == 255, 1.0, (bytes_ + 0.5) / 256))
        rest = ((values - 0.5) * _REACH).reshape(count, 3, -1).swapaxes(1, 2)
        harmonics = np.concatenate([harmonics, rest], axis=1)
    return {
        "means": in_chunk(units[0], _names(0)).astype(np.float32),
        "log_scales": in_chunk(units[1], _names(1)).astype(np.float32),
        "quaternions": from_smallest_three((turns >> 30).astype(int), others),
        "opacity_logits": logits(shades[:, 3]),
        "harmonics": harmonics.astype(np.float32),
    }


def _names(group: int) -> tuple[str, ...]:
    return _LIMITS[3 * group : 3 * group + 3]


def _unorm(values: np.ndarray, bits: int) -> np.ndarray:
    """Return values in [0, 1] as whole numbers of some bits."""
    most = (1 << bits) - 1
    return np.clip(np.floor(values * most + 0.5), 0, most).astype(np.uint32)


def _field(packed: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """Return bits of packed numbers as values in [0, 1]."""
    most = (1 << bits) - 1
    return ((packed >> np.uint32(shift)) & np.uint32(most)) / most
