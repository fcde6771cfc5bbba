"""Gaussians as plain arrays, and their harmonics as functions of a direction."""

import json
import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import NOT_FINITE_REMEDY, InputError

log = logging.getLogger(__name__)
HARMONIC_0 = 0.5 / math.sqrt(math.pi)  # The harmonic of degree 0
MAX_DEGREE = 3
SHORTEST_TIME, LONGEST_TIME = 1e-12, 1e12
"""Seconds that a base exposure time may have; beyond, radiance leaves the range of float32."""
LARGEST_SCALE = 1e6  # Largest factor of one export; a file that is exported again has the product of its factors
_MOST_LOGIT = 20.0  # A logit beyond this is an opacity of 0 or 1 in float32
# Sizes are drawn within e^-20 to e^20 scene units; further ones would overflow where files hold sizes themselves.
_MOST_LOG_SCALE = 20.0
_LEAST_VARIANCE = 1e-6  # Part of a size's variance that remains without the filter, where float32 holds no less
_COARSE = 1e-3  # Of the size of Gaussians: larger errors of float32 positions keep them in float64


@dataclass(frozen=True)
class GaussianArrays:
    """N Gaussians as NumPy arrays, float32; means in float64 where float32 would move them, as in UTM coordinates.

    Attributes:
        means: [N, 3] world coordinates.
        log_scales: [N, 3] natural logarithm of the standard deviations.
        quaternions: [N, 4] (w x y z).
        opacity_logits: [N].
        harmonics: [N, (degree + 1)^2, 3], degree 0 to 3.
        color_model: Meaning of the harmonics' sum over a viewing direction, per channel. "display": sRGB-encoded color
            max(sum + 0.5, 0), as every 3DGS viewer reads it; "log": scene-linear radiance exp(sum); "linear": max(sum,
            0).
        base_time: Seconds at which the scene was photographed; for display colors, the exposure time of the photo that
            they show.
        world_matrix: [4, 4] float64 from the photos' coordinates to these; None if they are the same.
        antialiased: To be rendered with opacity compensation (gsplat's mode "antialiased", "mip" in PLY): renderers of
            the common mode show small Gaussians brighter.
        filters: [N] standard deviations of the low-pass filter of the photos where the Gaussians are, in the unit of
            the means; see with_filter(). None if they are not known.
        photo_focals: Least and largest focal length of the photos, pixels; None if they are not known.
        along_rays: To be drawn along the rays of pixels, as most photos are panoramas or fisheye; see RadianceField.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray
    harmonics: np.ndarray
    color_model: str
    base_time: float
    world_matrix: np.ndarray | None = None
    antialiased: bool = False
    filters: np.ndarray | None = None
    photo_focals: tuple[float, float] | None = None
    along_rays: bool = False

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    @property
    def opacities(self) -> np.ndarray:
        """Opacities [N] in (0, 1)."""
        return (1 / (1 + np.exp(-self.opacity_logits.astype(np.float64)))).astype(np.float32)

    @property
    def unit_quaternions(self) -> np.ndarray:
        """Quaternions [N, 4] of length 1; the identity for those that are zero."""
        length = np.linalg.norm(self.quaternions, axis=1, keepdims=True)
        return np.where(length > 0, self.quaternions / np.where(length > 0, length, 1), [1, 0, 0, 0]).astype(np.float32)

    @property
    def axis_deviations(self) -> np.ndarray:
        """Standard deviations [N, 3] along x, y and z, float64."""
        from scipy.spatial.transform import Rotation

        rotations = Rotation.from_quat(self.unit_quaternions, scalar_first=True).as_matrix()
        return np.sqrt(np.einsum("nij,nj->ni", rotations**2, np.exp(2 * self.log_scales.astype(np.float64))))

    def with_filter(self) -> "GaussianArrays":
        """Return a copy whose sizes include the low-pass filter of the photos, as files hold them.

        In a training the rasterizer widens what it projects by this filter. At other sizes of a picture its filter is
        another part of the scene, and small Gaussians lose their light or gain some. With the filter in their sizes
        they keep it in renderers that have no filter or compensate opacities, and nearly in others, if they do not
        render coarser pictures than the photos (after the 3D smoothing filter of Yu et al. 2024; opacities stay,
        because those of the training were not compensated).
        """
        if self.filters is None or self.antialiased:
            return self
        variances = np.exp(2 * self.log_scales.astype(np.float64)) + np.square(self.filters, dtype=np.float64)[:, None]
        return replace(self, log_scales=(0.5 * np.log(variances)).astype(np.float32), antialiased=True)

    @property
    def filter_shares(self) -> np.ndarray | None:
        """Filters [N] that sizes include, over the smallest size, below 1; None if sizes include none.

        A ratio stays true in a file that another program scales.
        """
        if self.filters is None or not self.antialiased:
            return None
        return self.filters / np.exp(self.log_scales.min(axis=1))

    def without_filter(self, shares: np.ndarray) -> "GaussianArrays":
        """Return a copy without the filter that sizes include, which with_filter() included; see filter_shares."""
        variances = np.exp(2 * self.log_scales.astype(np.float64))
        filters = np.clip(shares, 0, 1) * np.sqrt(variances.min(axis=1))
        variances = np.maximum(variances - np.square(filters)[:, None], _LEAST_VARIANCE * variances)
        log_scales = (0.5 * np.log(variances)).astype(np.float32)
        return replace(self, log_scales=log_scales, antialiased=False, filters=filters.astype(np.float32))

    def with_colors(self, harmonics: np.ndarray, color_model: str) -> "GaussianArrays":
        """Return a copy with other harmonics and color model."""
        return replace(self, harmonics=np.ascontiguousarray(harmonics, np.float32), color_model=color_model)

    def padded(self, degree: int) -> "GaussianArrays":
        """Return a copy with harmonics up to `degree`, zero beyond its own; never fewer."""
        missing = max((degree + 1) ** 2 - self.harmonics.shape[1], 0)
        return replace(self, harmonics=np.pad(self.harmonics, ((0, 0), (0, missing), (0, 0))))

    def transformed(self, matrix: np.ndarray) -> "GaussianArrays":
        """Return a copy moved by a similarity, with turned harmonics; `world_matrix` then includes the move.

        Args:
            matrix: [4, 4] that acts on column vectors: one scale, a proper rotation and a translation.
        """
        from scipy.spatial.transform import Rotation

        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        rotation = matrix[:3, :3] / scale
        turned = Rotation.from_matrix(rotation) * Rotation.from_quat(self.unit_quaternions, scalar_first=True)
        before = np.eye(4) if self.world_matrix is None else self.world_matrix
        log_scales = (self.log_scales + np.log(scale)).astype(np.float32)
        return replace(
            self,
            means=rounded_means(self.means.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3], log_scales),
            log_scales=log_scales,
            quaternions=turned.as_quat(scalar_first=True).astype(np.float32),
            harmonics=rotate_harmonics(self.harmonics, rotation),
            world_matrix=matrix @ before,
            filters=None if self.filters is None else self.filters * np.float32(scale),
        )

    def rows(self, index: np.ndarray) -> "GaussianArrays":
        """Return the Gaussians at an index or mask [N]."""
        filters = None if self.filters is None else self.filters[index]
        return replace(self, filters=filters, **{name: getattr(self, name)[index] for name in _ARRAYS})

    def checked(self, path: Path | str) -> "GaussianArrays":
        """Return a copy without Gaussians that are not finite.

        Raises:
            InputError: If none is left, arrays differ in length, or the base time is not positive.
        """
        if len(lengths := {len(getattr(self, name)) for name in _ARRAYS}) > 1:
            raise InputError(path, f"its arrays are of {sorted(lengths)} Gaussians", "export it again")
        if not SHORTEST_TIME <= self.base_time <= LONGEST_TIME:
            problem = f"its base exposure time is {self.base_time} s"
            raise InputError(path, problem, f"state one of {SHORTEST_TIME} to {LONGEST_TIME} s")
        logits = np.clip(self.opacity_logits, -_MOST_LOGIT, _MOST_LOGIT)
        log_scales = np.clip(self.log_scales, -_MOST_LOG_SCALE, _MOST_LOG_SCALE)
        clamped = replace(self, opacity_logits=logits, log_scales=log_scales)
        arrays = (getattr(clamped, name) for name in _ARRAYS)
        finite = np.all([np.isfinite(each).all(tuple(range(1, each.ndim))) for each in arrays], axis=0)
        if not finite.any():
            problem = "all of its Gaussians have values that are not finite" if self.count else "holds no Gaussian"
            raise InputError(path, problem, "export it again")
        if finite.all():
            return clamped
        log.warning("%s: %d of %d Gaussians are not finite and were left out", path, (~finite).sum(), self.count)
        return clamped.rows(finite)

    def require_finite(self, path: Path | str) -> None:
        """Raise InputError with field, count and the first index if a value is NaN or infinite."""
        for name in _ARRAYS:
            bad = ~np.isfinite(getattr(self, name)).reshape(self.count, -1).all(1)
            if bad.any():
                fault = f"{name} of {int(bad.sum())} Gaussians are not finite, the first at {int(np.argmax(bad))}"
                raise InputError(path, fault, NOT_FINITE_REMEDY)


_ARRAYS = tuple(field.name for field in fields(GaussianArrays))[:5]


def join_gaussians(parts: Sequence[GaussianArrays]) -> GaussianArrays:
    """Return several sets of Gaussians in one space, of one color model and exposure, as one of the largest degree."""
    degree = max(part.degree for part in parts)
    padded = [part.padded(degree) for part in parts]
    filters = [part.filters for part in parts if part.filters is not None]
    least, most = zip(*(part.photo_focals or (0.0, 0.0) for part in parts), strict=True)
    return replace(
        padded[0],
        filters=np.concatenate(filters) if len(filters) == len(parts) else None,
        photo_focals=(min(least), max(most)) if all(least) else None,
        along_rays=all(part.along_rays for part in parts),
        **{name: np.concatenate([getattr(part, name) for part in padded]) for name in _ARRAYS},
    )


def rounded_means(means: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """Return means [N, 3] float64 as float32, unless that moves a tenth of them by a thousandth of their size.

    Of a scene near the origin, float32 moves what is far away most, but what is far away is large.
    """
    rounded = means.astype(np.float32)
    moved = np.abs(rounded - means).max(axis=1) / np.exp(log_scales.mean(axis=1))
    return means if len(means) and np.percentile(moved, 90) > _COARSE else rounded


def degree_of(coefficients: float, path: Path) -> int:
    """Return the degree with this many coefficients per channel; raise InputError if there is none."""
    degree = round(math.sqrt(coefficients)) - 1
    if (degree + 1) ** 2 != coefficients or not 0 <= degree <= MAX_DEGREE:
        problem = f"has {coefficients:.4g} harmonics for each channel, not 1, 4, 9 or 16"
        raise InputError(path, problem, "export it with degree 0 to 3")
    return degree


def stated_facts(gaussians: GaussianArrays) -> dict[str, Any]:
    """Return what files state of Gaussians beside their arrays, as plain values; without what is not known."""
    facts: dict[str, Any] = {"base_exposure_time": gaussians.base_time}
    if gaussians.photo_focals is not None:
        facts["photo_focals"] = list(gaussians.photo_focals)
    if gaussians.along_rays:
        facts["along_rays"] = True
    if gaussians.world_matrix is not None:
        facts["world_matrix"] = gaussians.world_matrix.tolist()
    return facts


def read_facts(facts: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return arguments of GaussianArrays by what stated_facts() returned; values may be text, lists JSON.

    Raises:
        InputError: If focal lengths are not two positive numbers in order, or the matrix is not a similarity.
    """
    result: dict[str, Any] = {"base_time": math.nan}  # GaussianArrays.checked() refuses it.
    result["along_rays"] = str(facts.get("along_rays")).lower() in ("true", "1.0")  # OpenUSD's is a number.
    with suppress(TypeError, ValueError, OverflowError):
        result["base_time"] = float(facts.get("base_exposure_time", 1.0))
    if (focals := facts.get("photo_focals")) is not None:
        try:
            low, high = map(float, json.loads(focals) if isinstance(focals, str) else focals)
        except (TypeError, ValueError, OverflowError, RecursionError):
            low, high = math.nan, math.nan
        if not 0 < low <= high < math.inf:
            problem = f"its focal lengths of the photos are {focals!s:.60}, not two positive numbers in order"
            raise InputError(path, problem, "export it again")
        result["photo_focals"] = low, high
    if (matrix := facts.get("world_matrix")) is not None:
        values = np.full((4, 4), math.nan)
        with suppress(TypeError, ValueError, OverflowError, RecursionError):
            read = json.loads(matrix) if isinstance(matrix, str) else matrix
            values = np.reshape(np.array(read, np.float64), (4, 4))
        try:
            result["world_matrix"] = similarity(values)
        except ValueError as error:
            raise InputError(path, f"its world_matrix {error}", "leave that entry out of the file") from None
    return result


def similarity(matrix: Any) -> np.ndarray:
    """Return a matrix [4, 4] float64 that acts on column vectors: a proper rotation, a translation and one scale.

    Raises ValueError for another kind, or a scale outside 1e-13 to 1e13.
    """
    values = np.array(matrix, np.float64)
    if values.shape != (4, 4) or not np.isfinite(values).all() or not np.allclose(values[3], (0, 0, 0, 1)):
        raise ValueError("is not an affine 4 x 4 matrix")
    scale = np.cbrt(np.linalg.det(values[:3, :3]))
    if not 1e-13 <= scale <= 1e13:  # Two exports by LARGEST_SCALE, and rounding
        raise ValueError("does not keep orientation or size")
    rotation = values[:3, :3] / scale
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
        raise ValueError("is not a rotation with one scale")
    return values


def harmonic_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return [..., (degree + 1)^2] float64 real spherical harmonics of unit directions [..., 3].

    They are orthonormal over the sphere, with the Condon-Shortley phase and in the order of 3D Gaussian Splatting: l =
    0, 1, ..., and m = -l ... l. The degree is 0 to 3.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    basis = [np.full_like(x, HARMONIC_0)]
    if degree > 0:
        c = math.sqrt(3 / (4 * math.pi))
        basis += [-c * y, c * z, -c * x]
    if degree > 1:
        c = math.sqrt(15 / (4 * math.pi))
        basis += [c * x * y, -c * y * z, c / math.sqrt(12) * (3 * z * z - 1), -c * x * z, c / 2 * (x * x - y * y)]
    if degree > 2:
        a, b, c = (math.sqrt(factor / (32 * math.pi)) for factor in (35, 21, 210))
        basis += [
            -a * y * (3 * x * x - y * y),
            2 * c * x * y * z,
            -b * y * (5 * z * z - 1),
            math.sqrt(7 / (16 * math.pi)) * z * (5 * z * z - 3),
            -b * x * (5 * z * z - 1),
            c * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return np.stack(basis, axis=-1)


def rotate_harmonics(harmonics: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return harmonics [N, K, 3] of functions turned by a rotation [3, 3]: f'(rotation @ d) = f(d).

    Harmonics of one degree turn into harmonics of that degree, so the matrix between them follows exactly from as many
    directions as there are coefficients, or more.
    """
    degree = math.isqrt(harmonics.shape[1]) - 1
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = np.linalg.pinv(harmonic_basis(directions @ rotation.T, degree)) @ harmonic_basis(directions, degree)
    return np.einsum("ij,njc->nic", turned, harmonics.astype(np.float64)).astype(np.float32)


def colors_of_basis(gaussians: GaussianArrays, basis: np.ndarray) -> np.ndarray:
    """Return [N, D, 3] colors, as the color model defines them, for the harmonic_basis() of directions."""
    value = basis @ gaussians.harmonics.astype(np.float64)
    if gaussians.color_model == "log":
        return np.exp(np.clip(value, -80, 80))
    return np.maximum(value + (0.5 if gaussians.color_model == "display" else 0.0), 0)
