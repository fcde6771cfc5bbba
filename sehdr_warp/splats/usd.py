"""OpenUSD's ParticleField3DGaussianSplat, with scene-linear Rec.709 radiance in float harmonics.

As in 3D Gaussian Splatting, which the schema stands for, a color is max(sum + 0.5, 0): the constant term carries the
radiance less 0.5. Coefficients of a Gaussian stand side by side; scales are linear and opacities in [0, 1].
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, SehdrError, require_extra
from ..files import atomic_path
from ..sandbox import read_sandboxed
from .arrays import HARMONIC_0, GaussianArrays, degree_of, read_facts, stated_facts

COLOR_SPACE = "lin_rec709_scene"
_FACTS = {
    "base_exposure_time": ("sehdr:baseExposureTime", "Double"),
    "photo_focals": ("sehdr:photoFocals", "DoubleArray"),
    "along_rays": ("sehdr:alongRays", "Bool"),
    "world_matrix": ("sehdr:worldMatrix", "Matrix4d"),
}
"""Attribute and its type for each of stated_facts()."""
_FILTER, _COMPENSATED = "sehdr:filter", "sehdr:opacityCompensation"  # filter_shares and antialiased
_HARMONICS = "radiance:sphericalHarmonicsCoefficients"
_BIAS = 0.5 / HARMONIC_0
_FAINTEST = 1 / 255  # Opacity below which programs draw nothing of a Gaussian
_FAINT = 0.05  # Less opacity does not count for the extent: a single haze as large as a town would hide the scene in it


def pxr(module: str) -> Any:
    """Return a module of OpenUSD; raise SehdrError if it is not installed."""
    return require_extra(f"pxr.{module}", "OpenUSD is not installed", "usd")


def open_stage(path: Path) -> Any:
    """Open a stage whose files all lie in the folder of `path`.

    Call it only from functions that read_sandboxed calls: a damaged file can make OpenUSD fill any memory.
    """
    stage = pxr("Usd").Stage.Open(str(path))
    folder = path.resolve().parent
    for layer in stage.GetUsedLayers():
        if not layer.anonymous and not Path(layer.realPath).resolve().is_relative_to(folder):
            raise ValueError(f"leads outside of its folder, to {layer.identifier}")
    return stage


def write_usd(path: Path, gaussians: GaussianArrays, overwrite: bool) -> None:
    """Write a .usda, .usdc or .usdz file; arguments as in write_gaussians."""
    packed = path.suffix.lower() == ".usdz"
    with atomic_path(path, overwrite) as temporary, writing_usd(path):
        layer = temporary.with_suffix(".usdc") if packed else temporary
        try:
            _write_stage(layer, gaussians)
            package, asset = pxr("UsdUtils").CreateNewUsdzPackage, pxr("Sdf").AssetPath(str(layer))
            if packed and not package(asset, str(temporary), "splats.usdc"):
                raise SehdrError(f"{path}: cannot be packed as USDZ; write .usdc instead")
        finally:
            if packed:
                layer.unlink(missing_ok=True)


@contextmanager
def writing_usd(path: Path) -> Iterator[None]:
    """Turn OpenUSD's errors while `path` is written (a full disk) into a SehdrError of one line."""
    errors = pxr("Tf").ErrorException
    try:
        yield
    except errors as error:
        reason = " ".join(str(error).split())
        raise SehdrError(f"{path}: cannot be written ({reason:.160}); free space or choose another folder") from None


def _write_stage(path: Path, gaussians: GaussianArrays) -> None:
    """Write a layer with one prim of Gaussians."""
    Usd, UsdGeom, UsdVol, Sdf = (pxr(name) for name in ("Usd", "UsdGeom", "UsdVol", "Sdf"))
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    splat = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Splats")
    prim = splat.GetPrim()
    stage.SetDefaultPrim(prim)
    Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(COLOR_SPACE)
    for fact, value in stated_facts(gaussians).items():
        name, kind = _FACTS[fact]
        if kind == "Matrix4d":
            value = pxr("Gf").Matrix4d(np.array(value).T.tolist())  # USD's matrices act on row vectors.
        prim.CreateAttribute(name, getattr(Sdf.ValueTypeNames, kind), True).Set(value)
    if gaussians.antialiased:
        prim.CreateAttribute(_COMPENSATED, Sdf.ValueTypeNames.Bool, True).Set(True)
    if (shares := gaussians.filter_shares) is not None:
        prim.CreateAttribute(_FILTER, Sdf.ValueTypeNames.FloatArray, True).Set(_array("FloatArray", shares))
    harmonics = gaussians.harmonics.astype(np.float32, copy=True)
    harmonics[:, 0] -= _BIAS
    splat.CreatePositionsAttr(_array("Vec3fArray", gaussians.means))
    splat.CreateScalesAttr(_array("Vec3fArray", np.exp(gaussians.log_scales)))
    quaternions = np.roll(gaussians.unit_quaternions, -1, axis=1)  # The real part is last.
    splat.CreateOrientationsAttr(_array("QuatfArray", quaternions))
    splat.CreateOpacitiesAttr(_array("FloatArray", gaussians.opacities))
    splat.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.degree)
    radiance = splat.CreateRadianceSphericalHarmonicsCoefficientsAttr(_array("Vec3fArray", harmonics.reshape(-1, 3)))
    radiance.SetMetadata("elementSize", harmonics.shape[1])
    splat.CreateExtentAttr(_array("Vec3fArray", _extent(gaussians)))
    stage.GetRootLayer().Save()


def read_usd(path: Path) -> GaussianArrays:
    """Read the one ParticleField3DGaussianSplat of a stage, in world coordinates."""
    pxr("Usd")
    arrays = read_sandboxed(usd_arrays, path, "USD", "export it again")
    if arrays["count"] != 1:
        problem = f"has {arrays['count']} prims of ParticleField3DGaussianSplat, not one"
        raise InputError(path, problem, "export Gaussians by OpenUSD's schema")
    if str(arrays["space"]) not in ("", COLOR_SPACE, "lin_rec709"):
        problem = f"its color space is {arrays['space']!s:.60}, not {COLOR_SPACE}"
        raise InputError(path, problem, "export it scene-linear in Rec.709")
    if not np.allclose(arrays["matrix"], np.eye(4)):
        raise InputError(path, "its Gaussians are moved by a transform", "bake the transform into the Gaussians")

    def values(name: str, columns: int) -> np.ndarray:
        if name not in arrays or arrays[name].size % columns:
            raise InputError(path, f"has no usable {name}", "export it again")
        return arrays[name].reshape(-1, columns)

    means, scales = values("positions", 3), values("scales", 3)
    quaternions, opacities = np.roll(values("orientations", 4), 1, axis=1), values("opacities", 1)[:, 0]
    degree = int(arrays["degree"])
    coefficients = (degree + 1) ** 2
    degree_of(coefficients, path)
    harmonics = values(_HARMONICS, 3 * coefficients).reshape(-1, coefficients, 3)
    harmonics[:, 0] += _BIAS
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales, logits = np.log(scales), np.log(opacities) - np.log1p(-opacities)
    gaussians = GaussianArrays(
        means=means,
        log_scales=log_scales,
        quaternions=quaternions,
        opacity_logits=logits,
        harmonics=harmonics,
        color_model="linear",
        antialiased=bool(arrays["compensated"]),
        **read_facts({name: arrays[name] for name in _FACTS if name in arrays}, path),
    )
    if _FILTER not in arrays:
        return gaussians
    if len(shares := values(_FILTER, 1)[:, 0]) != len(scales):
        raise InputError(path, f"its {_FILTER} has {len(shares)} values, not {len(scales)}", "export it again")
    return gaussians.without_filter(shares)


def usd_arrays(path: Path) -> dict[str, Any]:
    """Return how many prims of Gaussians a stage has, and the attributes of the first."""
    Usd, UsdGeom, UsdVol = (pxr(name) for name in ("Usd", "UsdGeom", "UsdVol"))
    stage = open_stage(path)
    prims = [prim for prim in stage.Traverse() if prim.IsA(UsdVol.ParticleField3DGaussianSplat)]
    if len(prims) != 1:
        return {"count": len(prims)}
    prim, splat = prims[0], UsdVol.ParticleField3DGaussianSplat(prims[0])
    to_world = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.EarliestTime())
    arrays = {
        "count": 1,
        "space": str(Usd.ColorSpaceAPI.ComputeColorSpaceName(prim, None) or ""),
        "matrix": np.array(to_world),
        "degree": int(_value(splat.GetRadianceSphericalHarmonicsDegreeAttr()) or 0),
    }
    arrays["compensated"] = prim.HasAttribute(_COMPENSATED) and bool(prim.GetAttribute(_COMPENSATED).Get())
    for fact, (name, _) in _FACTS.items():
        if prim.HasAttribute(name):
            arrays[fact] = np.array(prim.GetAttribute(name).Get(), np.float64).T
    for name in ("positions", "scales", "orientations", "opacities", _HARMONICS, _FILTER):
        for value in filter(None, (_value(prim.GetAttribute(each)) for each in (f"{name}h", name))):
            arrays[name] = np.array(value, np.float32)
    return arrays


def _value(attribute: Any) -> Any:
    """Return an attribute's value, at its first time if it is authored at times alone."""
    value = attribute.Get()
    return attribute.Get(pxr("Usd").TimeCode.EarliestTime()) if value is None else value


def _array(kind: str, values: np.ndarray):
    return getattr(pxr("Vt"), kind).FromNumpy(np.ascontiguousarray(values, np.float32))


def _extent(gaussians: GaussianArrays) -> np.ndarray:
    """Return corners [2, 3] of the box that viewers cull by and frame.

    It holds what programs draw of the Gaussians but the faint ones, or of all if all are faint.
    """
    counted = gaussians.opacities >= _FAINT
    gaussians = gaussians.rows(counted) if counted.any() else gaussians
    deviations = np.sqrt(2 * np.log(np.maximum(gaussians.opacities.astype(np.float64) / _FAINTEST, 1)))
    reach = deviations[:, None] * gaussians.axis_deviations
    return np.stack([(gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)])
