"""Gaussians as PLY files with the attribute names of 3D Gaussian Splatting, which every splat viewer reads.

x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..3(K-1)-1 (all coefficients of red, then of green, then of blue), opacity
(logit), scale_0..2 (logarithm), rot_0..3 (w x y z); little-endian float32. Kerbl et al. 2023, the reference release.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sehdr_warp.errors import InputError

from .files import atomic_path

COLOR_MODELS = ("display", "log", "linear")
"""What the sum of harmonics over a viewing direction d means, per channel:

display: sRGB-encoded colour max(sum + 0.5, 0), as every 3DGS viewer takes it.
log: scene-linear radiance exp(sum). linear: scene-linear radiance max(sum, 0).
"""

# Ten times the largest published scenes; bounds memory at about 14 GB of harmonics before anything is read.
MAX_GAUSSIANS = 60_000_000
_MAX_HEADER_BYTES = 1 << 16
_COMMENT = "sehdr:"
_DAMAGED = "export it again, as a binary PLY of 3D Gaussians"


@dataclass(frozen=True)
class GaussianArrays:
    """N Gaussians as NumPy arrays, float32.

    means [N, 3] world; log_scales [N, 3], natural logarithm of the standard deviations; quaternions [N, 4] (w x y z);
    opacity_logits [N]; harmonics [N, K, 3] with K = (degree + 1)^2, degree 0 to 3.
    color_model: one of COLOR_MODELS. base_exposure_time: seconds at which the scene was photographed; None if unknown.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray
    harmonics: np.ndarray
    color_model: str = "display"
    base_exposure_time: float | None = None

    def __post_init__(self):
        count, harmonics = len(self.means), self.harmonics.shape[1]
        expected = ((count, 3), (count, 3), (count, 4), (count,), (count, harmonics, 3))
        arrays = (self.means, self.log_scales, self.quaternions, self.opacity_logits, self.harmonics)
        for array, shape in zip(arrays, expected, strict=True):
            if array.shape != shape:
                raise ValueError(f"Gaussian array has shape {array.shape}, not {shape}")
        if harmonics not in (1, 4, 9, 16):
            raise ValueError(f"{harmonics} harmonics are not those of degree 0 to 3")
        if self.color_model not in COLOR_MODELS:
            raise ValueError(f"colour model {self.color_model!r} is not one of {COLOR_MODELS}")

    @property
    def degree(self) -> int:
        return math.isqrt(self.harmonics.shape[1]) - 1

    def with_colors(self, harmonics: np.ndarray, color_model: str) -> "GaussianArrays":
        """The same Gaussians in other colours."""
        return replace(self, harmonics=harmonics.astype(np.float32), color_model=color_model)


def write_gaussians(path: Path | str, gaussians: GaussianArrays, *, overwrite: bool = False) -> None:
    """Writes a PLY file; the colour model and the base exposure time are `comment sehdr:...` lines of its header.

    Raises InputError where a value is NaN or infinite (with field and index) or the file exists (unless overwrite),
    SehdrError where it cannot be written.
    """
    from plyfile import PlyData, PlyElement

    columns = _columns(gaussians)
    for name, values in columns.items():
        bad = ~np.isfinite(values)
        if bad.any():
            index = int(np.argmax(bad))
            raise InputError(
                path,
                f"{name} of {int(bad.sum())} Gaussians is not finite, the first {values[index]} at {index}",
                "such scenes are not written; train again from an earlier checkpoint or with another seed",
            )
    table = np.empty(len(gaussians.means), [(name, "<f4") for name in columns])
    for name, values in columns.items():
        table[name] = values
    comments = [f"{_COMMENT}color_model {gaussians.color_model}"]
    if gaussians.base_exposure_time is not None:
        comments.append(f"{_COMMENT}base_exposure_time {gaussians.base_exposure_time!r}")
    with atomic_path(path, overwrite) as temporary, temporary.open("wb") as file:
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=comments).write(file)


def read_gaussians(path: Path | str, *, max_gaussians: int = MAX_GAUSSIANS) -> GaussianArrays:
    """Reads a PLY file of 3D Gaussians, binary or ASCII; without a `sehdr:color_model` comment it is "display".

    Raises InputError where the file is missing, truncated, malformed, larger than max_gaussians, lacks a property, or
    holds NaN, infinity or a quaternion of length zero.
    """
    path = Path(path)
    table, comments = _read_table(path, max_gaussians)
    names = table.dtype.names

    def columns(*wanted: str) -> np.ndarray:
        missing = [name for name in wanted if name not in names]
        if missing:
            raise InputError(path, f"lacks the property {missing[0]}", _DAMAGED)
        values = np.stack([table[name] for name in wanted], axis=1).astype(np.float32)
        bad = ~np.isfinite(values)
        if bad.any():
            index, column = (int(i) for i in np.argwhere(bad)[0])
            raise InputError(path, f"{wanted[column]} of Gaussian {index} is {values[index, column]}", _DAMAGED)
        return values

    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in (0, 9, 24, 45):
        raise InputError(path, f"has {rest} f_rest properties, not 0, 9, 24 or 45", _DAMAGED)
    means, quaternions = columns("x", "y", "z"), columns("rot_0", "rot_1", "rot_2", "rot_3")
    lengths = np.linalg.norm(quaternions, axis=1)
    if (lengths < 1e-12).any():
        raise InputError(path, f"the rotation of Gaussian {int(np.argmin(lengths))} is zero", _DAMAGED)
    harmonics = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        higher = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(len(means), 3, rest // 3)
        harmonics = np.concatenate([harmonics, higher.swapaxes(1, 2)], axis=1)
    model = comments.get("color_model", "display")
    if model not in COLOR_MODELS:
        raise InputError(path, f"sehdr:color_model {model!r} is not one of {', '.join(COLOR_MODELS)}", _DAMAGED)
    return GaussianArrays(
        means,
        columns("scale_0", "scale_1", "scale_2"),
        quaternions,
        columns("opacity")[:, 0],
        np.ascontiguousarray(harmonics),
        model,
        _time(comments.get("base_exposure_time")),
    )


def _columns(gaussians: GaussianArrays) -> dict[str, np.ndarray]:
    """Property name -> [N], in the order of the reference release."""
    zero = np.zeros(len(gaussians.means), np.float32)
    rest = gaussians.harmonics[:, 1:].swapaxes(1, 2).reshape(len(gaussians.means), -1)
    return {
        **dict(zip("xyz", gaussians.means.T, strict=True)),
        **dict.fromkeys(("nx", "ny", "nz"), zero),
        **{f"f_dc_{i}": gaussians.harmonics[:, 0, i] for i in range(3)},
        **{f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])},
        "opacity": gaussians.opacity_logits,
        **{f"scale_{i}": gaussians.log_scales[:, i] for i in range(3)},
        **{f"rot_{i}": gaussians.quaternions[:, i] for i in range(4)},
    }


def _read_table(path: Path, max_gaussians: int) -> tuple[np.ndarray, dict[str, str]]:
    """The vertex table and the `sehdr:` comments. The header is checked before any row is read."""
    from plyfile import PlyData, PlyParseError

    if not path.is_file():
        raise InputError(path, "no such file", "give a PLY file of 3D Gaussians")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER_BYTES)
        end = head.find(b"end_header")
        if not head.startswith(b"ply") or end < 0:
            raise InputError(path, "is not a PLY file, or its header does not end", _DAMAGED)
        _check_header(path, head[:end], size, max_gaussians)
        file.seek(0)
        try:
            # No memory map: plyfile's would hold the file open behind the arrays.
            ply = PlyData.read(file, mmap=False)
            table = ply["vertex"].data
        except (PlyParseError, KeyError, ValueError, OverflowError, UnicodeDecodeError, MemoryError) as error:
            raise InputError(path, f"cannot be read as PLY ({error})", _DAMAGED) from None
    if not len(table):
        raise InputError(path, "holds no Gaussians", _DAMAGED)
    if any(table.dtype[name].kind == "O" for name in table.dtype.names):
        raise InputError(path, "its vertices hold lists", _DAMAGED)
    comments = [line.removeprefix(_COMMENT).split(None, 1) for line in ply.comments if line.startswith(_COMMENT)]
    return table, dict(pair for pair in comments if len(pair) == 2)


def _check_header(path: Path, header: bytes, size: int, max_gaussians: int) -> None:
    """Refuses counts that the file cannot hold: the reader would allocate them first."""
    properties = 0
    count = 0
    for line in header.splitlines():
        words = line.split()
        if words[:1] == [b"element"]:
            if len(words) != 3 or not words[2].isdigit():
                raise InputError(path, "the header has a malformed element line", _DAMAGED)
            # The smallest row: one byte a property; in ASCII each value takes a digit and a separator.
            count, properties = int(words[2]), 0
            if words[1] == b"vertex" and count > max_gaussians:
                raise InputError(path, f"states {count} Gaussians, more than {max_gaussians}", "split the scene")
        elif words[:1] == [b"property"]:
            properties += 1
            if count * properties > size:
                raise InputError(path, f"states {count} rows, but the file has only {size} bytes", _DAMAGED)


def _time(text: str | None) -> float | None:
    try:
        value = float(text) if text is not None else None
    except ValueError:
        return None
    return value if value is not None and math.isfinite(value) and value > 0 else None
