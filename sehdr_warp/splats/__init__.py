"""Files of Gaussians, and Gaussians as plain arrays: PLY, OpenUSD, glTF, SOG, SPZ and compressed PLY, by suffix.

NumPy alone is loaded here; USD needs the extra `usd`.
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from ..files import check_absent
from .arrays import GaussianArrays
from .compressed_ply import SUFFIX as COMPRESSED_PLY
from .compressed_ply import write_compressed_ply
from .gltf import read_glb, write_glb
from .ply import read_ply, write_ply
from .sog import read_sog, write_sog
from .spz import read_spz, write_spz
from .streamed_sog import NAME as STREAMED_SOG
from .streamed_sog import read_streamed_sog, write_streamed_sog
from .usd import pxr, read_usd, write_usd

log = logging.getLogger(__name__)
USD_SUFFIXES = (".usda", ".usdc", ".usd", ".usdz")


class Format(NamedTuple):
    """Reader, writer and properties of a kind of file."""

    read: Callable[[Path], GaussianArrays]  # Return the Gaussians of a file
    write: Callable[[Path, GaussianArrays, bool], object]  # Write Gaussians to a file; the last argument is `overwrite`
    color_model: str | None  # The one color model that the file can hold; None if it can hold any
    is_lossy: bool = False  # Whether the file holds rounded numbers, which take a tenth to a fourth of the space


FORMATS = {
    ".ply": Format(read_ply, write_ply, None),
    **dict.fromkeys(USD_SUFFIXES, Format(read_usd, write_usd, "linear")),
    ".glb": Format(read_glb, write_glb, "display"),
    ".sog": Format(read_sog, write_sog, "display", is_lossy=True),
    ".spz": Format(read_spz, write_spz, "display", is_lossy=True),
    COMPRESSED_PLY: Format(read_ply, write_compressed_ply, "display", is_lossy=True),
    STREAMED_SOG: Format(read_streamed_sog, write_streamed_sog, "display", is_lossy=True),
}
"""By suffix, and by name for streamed SOG."""
SUFFIXES = tuple(suffix for suffix in FORMATS if suffix != STREAMED_SOG)
_OTHER = {
    ".splat": "holds 8 bits and no harmonics; SplatTransform makes a PLY of it",
    ".ksplat": "holds a viewer's own compression; SplatTransform makes a PLY of it",
    ".gltf": "is glTF in pieces",
}


def check_suffix(path: Path | str, *others: str) -> str:
    """Return the suffix of a splat file in lower case, or lod-meta.json; the caller accepts `others` too.

    Raises:
        InputError: For a suffix that is neither read nor written.
    """
    name = Path(path).name.lower()
    suffix = COMPRESSED_PLY if name.endswith(COMPRESSED_PLY) else Path(name).suffix
    suffix = STREAMED_SOG if name == STREAMED_SOG else suffix
    if name == "meta.json":
        raise InputError(path, "is SOG in pieces", "zip it and the pictures beside it as scene.sog")
    if suffix not in (*FORMATS, *others):
        why = (
            f"{suffix} is not read or written here: it {_OTHER[suffix]}" if suffix in _OTHER else "is not a splat file"
        )
        raise InputError(path, why, f"use one of {' '.join((*FORMATS, *others))}")
    return suffix


def path_is_lossy(path: Path | str) -> bool:
    """Return whether a file of this suffix holds rounded numbers."""
    return FORMATS[check_suffix(path)].is_lossy


def required_color_model(path: Path | str) -> str | None:
    """Return the one color model that a file of this suffix can hold; None if it can hold any (PLY)."""
    return FORMATS[check_suffix(path)].color_model


def camera_file_of(path: Path) -> Path:
    """Return the path of the cameras that are written beside a file of Gaussians, in its coordinates."""
    return path.with_name(f"{path.name}.cameras.json")


def cameras_beside(path: Path) -> Path | None:
    """Return the file beside a file of Gaussians that holds cameras in its coordinates; None if there is none."""
    files = camera_file_of(path), path.with_name("cameras.json")
    return next((file for file in files if file.is_file()), None)


def check_new_file(path: Path, *, cameras: bool = False, overwrite: bool = False) -> None:
    """Raise InputError if a file of Gaussians, or cameras beside it, would replace what may not be replaced.

    Raises SehdrError for OpenUSD without its library.
    """
    if path.suffix.lower() in USD_SUFFIXES:
        pxr("Usd")
    if path.name == STREAMED_SOG:
        check_absent(path.parent, overwrite, folder=True)
        if cameras:
            raise InputError(path, "fills its folder, which has no place for cameras", "leave --cameras out")
    for file in (path, *[camera_file_of(path)] * cameras):
        check_absent(file, overwrite)


def read_gaussians(path: Path | str) -> GaussianArrays:
    """Read the Gaussians in a file of one of FORMATS.

    Gaussians with a value that is not finite are left out, with a warning.

    Raises:
        InputError: If the file is missing, damaged, of another kind or holds no Gaussian.
    """
    gaussians = FORMATS[check_suffix(path)].read(Path(path)).checked(path)
    if gaussians.antialiased:
        text = "%s: states opacity compensation, and is rendered with it; without it small Gaussians are brighter"
        log.info(text, path)
    return gaussians


def write_gaussians(path: Path | str, gaussians: GaussianArrays, *, overwrite: bool = False) -> None:
    """Write a file of one of FORMATS; sizes there include the photos' filter, if it is known (see with_filter).

    Raises:
        InputError: If a value is NaN or infinite (with field and index), the file exists (unless overwrite), or the
            format cannot hold these colors (see required_color_model).
        SehdrError: If the file cannot be written.
    """
    color_model = required_color_model(path)
    if color_model not in (None, gaussians.color_model):
        problem = f"holds {color_model} colors, and these are {gaussians.color_model}"
        raise InputError(path, problem, "choose another suffix, or let export change the colors")
    gaussians.require_finite(path)
    # Text of a NumPy scalar is not that of a number.
    gaussians = replace(gaussians.with_filter(), base_time=float(gaussians.base_time))
    if gaussians.means.dtype == np.float64:
        far = float(np.abs(gaussians.means).max())
        log.warning(
            "%s: positions up to %.4g are too large for the float32 of the file, which moves Gaussians; "
            "use --axes upright, which puts the scene at the origin",
            *(Path(path).name, far),
        )
    FORMATS[check_suffix(path)].write(Path(path), gaussians, overwrite)


__all__ = [
    "STREAMED_SOG",
    "SUFFIXES",
    "USD_SUFFIXES",
    "GaussianArrays",
    "camera_file_of",
    "cameras_beside",
    "check_new_file",
    "check_suffix",
    "path_is_lossy",
    "read_gaussians",
    "required_color_model",
    "write_gaussians",
]
