"""OpenUSD's ParticleField3DGaussianSplat, with scene-linear Rec.709 radiance in float harmonics.

As in 3D Gaussian Splatting, which the schema stands for, a color is max(sum + 0.5, 0): the constant term carries the
radiance less 0.5. Coefficients of a Gaussian stand side by side; scales are linear and opacities in [0, 1].
"""

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, SehdrError
from ..files import atomic_path
from .arrays import HARMONIC_0, GaussianArrays, degree_of

COLOR_SPACE = "lin_rec709_scene"
_BASE_TIME = "sehdr:baseExposureTime"
_BIAS = 0.5 / HARMONIC_0
# The extent that viewers clip by: three standard deviations hold 99.7 % of a Gaussian.
_DEVIATIONS = 3.0


def pxr(module: str) -> Any:
    """A module of OpenUSD; SehdrError where it is not installed."""
    from importlib import import_module

    try:
        return import_module(f"pxr.{module}")
    except ImportError:
        raise SehdrError("OpenUSD is not installed; pip install 'sehdr-warp[usd]'") from None


def open_stage(path: Path) -> Any:
    """A stage; InputError where the file is missing or damaged."""
    Usd, Tf = pxr("Usd"), pxr("Tf")
    if not path.is_file():
        raise InputError(path, "file not found", "check the name")
    try:
        return Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        reason = str(error).strip().splitlines()[-1]
        raise InputError(path, f"cannot be read as USD ({reason:.120})", "export it again") from None


def write_usd(path: Path, gaussians: GaussianArrays, overwrite: bool) -> None:
    Usd, UsdGeom, UsdVol, Sdf = (pxr(name) for name in ("Usd", "UsdGeom", "UsdVol", "Sdf"))
    packed = path.suffix.lower() == ".usdz"
    with atomic_path(path, overwrite) as temporary:
        layer = temporary.with_suffix(".usdc") if packed else temporary
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        splat = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Splats")
        prim = splat.GetPrim()
        stage.SetDefaultPrim(prim)
        Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(COLOR_SPACE)
        prim.CreateAttribute(_BASE_TIME, Sdf.ValueTypeNames.Double, True).Set(gaussians.base_time)
        harmonics = gaussians.harmonics.astype(np.float32, copy=True)
        harmonics[:, 0] -= _BIAS
        splat.CreatePositionsAttr(_array("Vec3fArray", gaussians.means))
        splat.CreateScalesAttr(_array("Vec3fArray", np.exp(gaussians.log_scales)))
        splat.CreateOrientationsAttr(_quaternions(gaussians.unit_quaternions))
        splat.CreateOpacitiesAttr(_array("FloatArray", gaussians.opacities))
        splat.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.degree)
        radiance = splat.CreateRadianceSphericalHarmonicsCoefficientsAttr(
            _array("Vec3fArray", harmonics.reshape(-1, 3))
        )
        radiance.SetMetadata("elementSize", harmonics.shape[1])
        splat.CreateExtentAttr(_array("Vec3fArray", _extent(gaussians)))
        stage.GetRootLayer().Save()
        if packed:
            try:
                package = pxr("UsdUtils").CreateNewUsdzPackage
                if not package(Sdf.AssetPath(str(layer)), str(temporary), "splats.usdc"):
                    raise SehdrError(f"{path}: cannot be packed as USDZ; write .usdc instead")
            finally:
                layer.unlink(missing_ok=True)


def read_usd(path: Path) -> GaussianArrays:
    """The one ParticleField3DGaussianSplat of a stage, where it stands in the world."""
    Usd, UsdGeom, UsdVol = (pxr(name) for name in ("Usd", "UsdGeom", "UsdVol"))
    stage = open_stage(path)
    found = [prim for prim in stage.Traverse() if prim.IsA(UsdVol.ParticleField3DGaussianSplat)]
    if len(found) != 1:
        problem = f"has {len(found)} prims of ParticleField3DGaussianSplat, not one"
        raise InputError(path, problem, "export Gaussians by OpenUSD's schema")
    prim, splat = found[0], UsdVol.ParticleField3DGaussianSplat(found[0])
    space = Usd.ColorSpaceAPI.ComputeColorSpaceName(prim, None)
    if space and str(space) not in (COLOR_SPACE, "lin_rec709"):
        raise InputError(path, f"its color space is {space}, not {COLOR_SPACE}", "export it scene-linear in Rec.709")

    def values(name: str, columns: int) -> np.ndarray:
        stored = next((v for n in (name, f"{name}h") if (v := prim.GetAttribute(n).Get())), None)
        if stored is None:
            raise InputError(path, f"{prim.GetPath()} has no {name}", "export it again")
        return np.array(stored, np.float32).reshape(-1, columns)

    means, scales = values("positions", 3), values("scales", 3)
    quaternions, opacities = np.roll(values("orientations", 4), 1, axis=1), values("opacities", 1)[:, 0]
    degree = int(splat.GetRadianceSphericalHarmonicsDegreeAttr().Get())
    coefficients = (degree + 1) ** 2
    degree_of(coefficients, path)
    harmonics = values("radiance:sphericalHarmonicsCoefficients", 3)
    lengths = {len(means), len(scales), len(quaternions), len(opacities), len(harmonics) / coefficients}
    if len(lengths) != 1:
        raise InputError(path, f"its arrays are of {sorted(lengths)} Gaussians", "export it again")
    harmonics = harmonics.reshape(-1, coefficients, 3)
    harmonics[:, 0] += _BIAS
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
    if not np.allclose(matrix, np.eye(4)):
        raise InputError(path, f"{prim.GetPath()} is moved by a transform", "bake the transform into the Gaussians")
    stated = prim.GetAttribute(_BASE_TIME).Get() if prim.HasAttribute(_BASE_TIME) else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales, logits = np.log(scales), np.log(opacities) - np.log1p(-opacities)
    return GaussianArrays(means, log_scales, quaternions, logits, harmonics, "linear", float(stated))


def _array(kind: str, values: np.ndarray):
    return getattr(pxr("Vt"), kind).FromNumpy(np.ascontiguousarray(values, np.float32))


def _quaternions(values: np.ndarray):
    """OpenUSD's arrays hold the real part last."""
    return _array("QuatfArray", np.roll(values, -1, axis=1))


def _extent(gaussians: GaussianArrays) -> np.ndarray:
    reach = _DEVIATIONS * np.exp(gaussians.log_scales.max(axis=1, keepdims=True))
    return np.stack([(gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)])
