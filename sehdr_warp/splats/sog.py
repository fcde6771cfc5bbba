"""SOG (PlayCanvas), version 2: a ZIP of lossless WebP pictures and meta.json; display colors, about a tenth of a PLY.

Positions are 16 bits of a logarithm, sizes and colors codes of 256 levels, higher harmonics entries of a palette. Axes
are those of PLY. What this package adds stands under `sehdr` in meta.json, and in filters.webp: of each Gaussian, the
part of its smallest size that remains without the photos' filter.
"""

import io
import json
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from .. import __version__
from ..errors import InputError
from ..files import atomic_path, read_bytes
from ..json_values import damage
from .arrays import GaussianArrays, read_facts, stated_facts
from .packing import CODES, codebook, from_smallest_three, logits, morton_order, palette, smallest_three

_LARGEST_PALETTE, _PER_ENTRY, _ACROSS = 1 << 14, 2, 64  # Entries; Gaussians for each; entries side by side
_COEFFICIENTS = (0, 3, 8, 15)  # Of degrees 0 to 3, without the constant one
_MOST_BYTES, _MOST_PIXELS, _MOST_META = 1 << 30, 1 << 26, 1 << 24
_SPARE_PIXELS, _PIXEL_BYTES = 1 << 20, 5
"""Pixels of a picture beyond four for each Gaussian, and bytes that an incompressible one of them may take."""
_DAMAGED = "export it again"
# What a damaged file makes of its numbers, names and pictures; RuntimeError includes encrypted entries.
_FAULTS = (KeyError, IndexError, TypeError, ValueError, OSError, AttributeError, RuntimeError, OverflowError)


def write_sog(path: Path, gaussians: GaussianArrays, overwrite: bool) -> None:
    """Write a .sog file; arguments as in write_gaussians."""
    with atomic_path(path, overwrite) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in sog_files(gaussians):
            # The date is the same in every file, and pictures are compressed already.
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)


def sog_files(gaussians: GaussianArrays) -> Iterator[tuple[str, str | bytes]]:
    """Yield name and content of each file of a SOG: meta.json first, then the pictures."""
    gaussians = gaussians.rows(morton_order(gaussians.means))
    pictures = _Pictures(gaussians.count)
    spread = np.sign(gaussians.means) * np.log1p(np.abs(gaussians.means.astype(np.float64)))
    low, high = spread.min(axis=0), spread.max(axis=0)
    fixed = np.rint((spread - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.uint16)
    largest, others = smallest_three(gaussians.unit_quaternions.astype(np.float64))
    turns = np.concatenate([np.rint((others / 2 + 0.5) * 255), 252 + largest[:, None]], axis=1)
    scale_levels, scale_codes = codebook(gaussians.log_scales)
    color_levels, color_codes = codebook(gaussians.harmonics[:, 0])
    opacity = np.rint(gaussians.opacities * 255).astype(np.uint8)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": f"sehdr-warp {__version__}"},
        "count": gaussians.count,
        "antialias": gaussians.antialiased,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": [pictures.add("means_l.webp", fixed & 255), pictures.add("means_u.webp", fixed >> 8)],
        },
        "scales": {"codebook": scale_levels.tolist(), "files": [pictures.add("scales.webp", scale_codes)]},
        "quats": {"files": [pictures.add("quats.webp", turns)]},
        "sh0": {
            "codebook": color_levels.tolist(),
            "files": [pictures.add("sh0.webp", np.concatenate([color_codes, opacity[:, None]], axis=1))],
        },
        "sehdr": stated_facts(gaussians),
    }
    if (shares := gaussians.filter_shares) is not None:
        levels, codes = codebook(np.sqrt(1 - np.square(np.clip(shares, 0, 1)))[:, None])
        meta["sehdr"]["filters"] = {"codebook": levels.tolist(), "files": [pictures.add("filters.webp", codes)]}
    if gaussians.degree:
        meta["shN"] = _add_higher_harmonics(gaussians, pictures)
    yield "meta.json", json.dumps(meta)
    for name, texels in pictures.texels.items():
        buffer = io.BytesIO()
        Image.fromarray(texels, "RGBA").save(buffer, "WEBP", lossless=True, exact=True, quality=100, method=4)
        yield name, buffer.getvalue()


class _Pictures:
    """The pictures of a SOG.

    Attributes:
        texels: [height, width, 4] uint8 by file name.
    """

    def __init__(self, count: int):
        """Start without pictures, for so many Gaussians, each of which has a pixel in all but one of them."""
        self.count, self.texels = count, {}
        self.width = math.ceil(math.sqrt(count) / 4) * 4
        self.height = math.ceil(count / self.width / 4) * 4

    def add(self, name: str, columns: np.ndarray) -> str:
        """Add a picture of columns [count, C] of values from 0 to 255, up to four; return its name."""
        texels = np.full((self.width * self.height, 4), 255, np.uint8)
        texels[: self.count, : columns.shape[1]] = columns
        texels[self.count :, :3] = 0
        self.texels[name] = texels.reshape(self.height, self.width, 4)
        return name


def _add_higher_harmonics(gaussians: GaussianArrays, pictures: _Pictures) -> dict[str, Any]:
    """Add the pictures of the harmonics above degree 0, a palette and each Gaussian's entry; return their meta data."""
    count, degree = gaussians.count, gaussians.degree
    entries = min(_LARGEST_PALETTE, max(count // _PER_ENTRY, min(count, _ACROSS)))
    centers, labels = palette(gaussians.harmonics[:, 1:].reshape(count, -1), entries)
    levels, codes = codebook(centers)
    rows = math.ceil(entries / _ACROSS)
    texels = np.zeros((rows * _ACROSS, _COEFFICIENTS[degree], 4), np.uint8)
    texels[..., 3] = 255
    texels[:entries, :, :3] = codes.reshape(entries, -1, 3)
    pictures.texels["shN_centroids.webp"] = texels.reshape(rows, -1, 4)
    columns = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
    files = ["shN_centroids.webp", pictures.add("shN_labels.webp", columns)]
    return {"count": entries, "bands": degree, "codebook": levels.tolist(), "files": files}


def read_sog(path: Path) -> GaussianArrays:
    """Read a .sog file of version 2."""
    read_bytes(path)  # Refuses what is not a plain file or too large
    with refusing_damage(path), zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
            raise InputError(path, "unpacks to more than 1 GiB", _DAMAGED)
        # Some tools pack the folder, not the files in it.
        above = next((name[: -len("meta.json")] for name in archive.namelist() if name.endswith("/meta.json")), "")
        above = "" if "meta.json" in archive.namelist() else above
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}

        def read(name: str, limit: int) -> bytes:
            if sizes.get(above + name, 0) > limit:
                raise ValueError(f"{name} has {sizes[above + name]} bytes")
            return archive.read(above + name)

        return gaussians_of_files(read, path)


@contextmanager
def refusing_damage(path: Path) -> Iterator[None]:
    """Raise InputError in place of what a damaged file makes of its numbers, names and pictures."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # Values that are not finite are left out and counted later.
            yield
    except (zipfile.BadZipFile, zlib.error, RecursionError, Image.DecompressionBombError, *_FAULTS) as error:
        raise InputError(path, f"is damaged SOG ({damage(error)})", _DAMAGED) from None


def gaussians_of_files(read: Callable[[str, int], bytes], path: Path) -> GaussianArrays:
    """Return the Gaussians of a SOG of version 2; errors name `path`.

    read() returns the content of a file of it, and raises for one of more bytes than its second argument.
    """
    meta = json.loads(read("meta.json", _MOST_META))
    if meta.get("version") != 2:
        problem = f"is SOG of version {meta.get('version', 1)!r:.20}"
        raise InputError(path, problem, "version 2 is read; save it as that with SplatTransform, or as PLY")
    return _gaussians(read, meta, path)


def _gaussians(read: Callable[[str, int], bytes], meta: dict[str, Any], path: Path) -> GaussianArrays:
    count = int(meta["count"])
    if not 0 < count <= _MOST_PIXELS:
        raise ValueError(f"count {count}")

    most = min(_MOST_PIXELS, 4 * count + _SPARE_PIXELS)

    def texels(part: str, index: int = 0, parts: dict[str, Any] = meta) -> np.ndarray:
        values = _picture(read, parts[part]["files"][index], most).reshape(-1, 4)
        if len(values) < count:
            raise ValueError(f"{part} has {len(values)} texels for {count} Gaussians")
        return values[:count]

    def levels(part: str, parts: dict[str, Any] = meta) -> np.ndarray:
        values = np.array(parts[part]["codebook"], np.float32)
        if values.shape != (CODES,):
            raise ValueError(f"the codebook of {part} has shape {values.shape}")
        return values

    low, high = (np.array(meta["means"][name], np.float64).reshape(3) for name in ("mins", "maxs"))
    fixed = texels("means")[:, :3] + 256.0 * texels("means", 1)[:, :3]
    spread = low + (high - low) * fixed / 65535
    means = np.sign(spread) * np.expm1(np.abs(spread))
    turns = texels("quats").astype(int)
    if (turns[:, 3] < 252).any():
        raise ValueError("a rotation has no largest component")
    color, facts = texels("sh0"), meta.get("sehdr", {})
    degree = int(meta["shN"]["bands"]) if "shN" in meta else 0
    harmonics = np.zeros((count, _COEFFICIENTS[degree] + 1, 3), np.float32)
    harmonics[:, 0] = levels("sh0")[color[:, :3]]
    if degree:
        columns = texels("shN", 1).astype(int)
        entries = _picture(read, meta["shN"]["files"][0], _SPARE_PIXELS)
        entries = entries.reshape(len(entries) * _ACROSS, _COEFFICIENTS[degree], 4)[..., :3]
        harmonics[:, 1:] = levels("shN")[entries[columns[:, 0] + 256 * columns[:, 1]]]
    gaussians = GaussianArrays(
        means=means.astype(np.float32),
        log_scales=levels("scales")[texels("scales")[:, :3]],
        quaternions=from_smallest_three(turns[:, 3] - 252, turns[:, :3] / 255 * 2 - 1),
        opacity_logits=logits(color[:, 3] / 255),
        harmonics=harmonics,
        color_model="display",
        antialiased=meta.get("antialias") is True,
        **read_facts(facts, path),
    )
    if gaussians.photo_focals is None or not gaussians.antialiased or "filters" not in facts:
        return gaussians
    remains = levels("filters", facts)[texels("filters", 0, facts)[:, 0]]
    return gaussians.without_filter(np.sqrt(1 - np.square(np.clip(remains, 0, 1))))


def _picture(read: Callable[[str, int], bytes], name: str, most: int) -> np.ndarray:
    """Return the texels [H, W, 4] of a picture of at most `most` pixels."""
    with Image.open(io.BytesIO(read(name, _PIXEL_BYTES * most)), formats=["WEBP", "PNG"]) as image:
        if image.width * image.height > most:
            raise ValueError(f"{name} has {image.width} x {image.height} pixels")
        return np.asarray(image.convert("RGBA"))
