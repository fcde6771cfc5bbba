"""Gaussians as PLY files with the attribute names of 3D Gaussian Splatting, which every splat viewer reads.

x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..3(K-1)-1 (all coefficients of red, then of green, then of blue), opacity
(logit), scale_0..2 (logarithm), rot_0..3 (w x y z); little-endian float32. Kerbl et al. 2023, the reference release.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sehdr_warp.errors import InputError

from ..files import atomic_path

COLOR_MODELS = ("display", "log", "linear")
"""What the sum of harmonics over a viewing direction d means, per channel:

display: sRGB-encoded colour max(sum + 0.5, 0), as every 3DGS viewer takes it.
log: scene-linear radiance exp(sum). linear: scene-linear radiance max(sum, 0).
"""


@dataclass(frozen=True)
class GaussianArrays:
    """N Gaussians as NumPy arrays, float32.

    means [N, 3] world; log_scales [N, 3], natural logarithm of the standard deviations; quaternions [N, 4] (w x y z);
    opacity_logits [N]; harmonics [N, K, 3] with K = (degree + 1)^2, degree 0 to 3.
    color_model: one of COLOR_MODELS. base_exposure_time: seconds at which the scene was photographed.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray
    harmonics: np.ndarray
    color_model: str
    base_exposure_time: float

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
    comments = [
        f"sehdr:color_model {gaussians.color_model}",
        f"sehdr:base_exposure_time {gaussians.base_exposure_time!r}",
    ]
    with atomic_path(path, overwrite) as temporary, temporary.open("wb") as file:
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=comments).write(file)


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
