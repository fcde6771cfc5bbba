"""Cameras as other programs write them: OpenUSD stages and Nuke's .chan files.

OpenUSD: the whole chain of parents at every frame counts, as do the stage's up axis, its meters for each unit, lenses
and offsets of the filmback. Coordinates come back with +Y up and in meters, as files of this package are written.
"""

import math
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import InputError
from ...files import read_text
from ...sandbox import read_sandboxed
from ...splats import USD_SUFFIXES
from ...splats.usd import open_stage, pxr
from ..camera import Camera
from .transforms import pose_from_opengl

EXCHANGE_SUFFIXES = (*USD_SUFFIXES, ".chan")
USD_SIZE = ("sehdr:width", "sehdr:height")
"""Attributes of a UsdGeomCamera that state its picture's size in pixels, which USD itself does not."""
USD_WORLD_MATRIX = "sehdr:worldMatrix"
"""Entry of a stage's customLayerData: 16 numbers by rows, from the photos' coordinates to the stage's."""
CHAN_ROTATION = "zxy"  # Order of a .chan file's rotations about fixed axes, as Nuke and Blender take it by default
_SIZE = (1920, 1080)  # Pixels of a camera whose file states none
_MOST_FRAMES = 100_000


class ExchangeCameras(NamedTuple):
    """Cameras of a file."""

    cameras: list[tuple[str, Camera]]  # Name and camera in the file's order; NAME_0001 and so on of a moving one
    world_matrix: np.ndarray | None = None  # [4, 4] from the photos' coordinates to the file's; None if not stated
    up_stated: bool = True  # Whether the file states its up axis, or needs none


def read_exchange_cameras(path: Path) -> ExchangeCameras:
    """Read the cameras of an OpenUSD stage or a .chan file.

    Raises:
        InputError: If the file is damaged or a camera cannot be used.
    """
    return _read_chan(path) if path.suffix.lower() == ".chan" else _read_usd(path)


def _read_usd(path: Path) -> ExchangeCameras:
    pxr("Usd")
    arrays = read_sandboxed(usd_camera_arrays, path, "USD", "export it again")
    cameras = []
    for name, lens, matrix in zip(arrays["names"].tolist(), arrays["lenses"], arrays["matrices"], strict=True):
        try:
            cameras.append((name, _usd_camera(lens, matrix, path, name)))
        except (ValueError, OverflowError, ZeroDivisionError) as error:
            raise InputError(path, f"camera {name} cannot be used ({error!s:.120})", "correct the camera") from None
    world = arrays["world_matrix"]
    return ExchangeCameras(cameras, world if world.any() else None, bool(arrays["up_stated"]))


def usd_camera_arrays(path: Path) -> dict[str, Any]:
    """Return the perspective cameras of a stage as arrays.

    `names` [n]; `lenses` [n, 7]: width and height in pixels (0 if not stated), focal length, both apertures and both of
    their offsets in one unit; `matrices` [n, 4, 4], camera to world with +Y up and in meters, acting on column vectors;
    `world_matrix` [4, 4], zero if not stated; `up_stated`, whether the stage states its up axis.
    """
    Usd, UsdGeom = pxr("Usd"), pxr("UsdGeom")
    stage = open_stage(path)
    to_meters = UsdGeom.GetStageMetersPerUnit(stage) if UsdGeom.StageHasAuthoredMetersPerUnit(stage) else 1.0
    if not 0 < to_meters < math.inf:
        raise ValueError(f"its metersPerUnit is {to_meters}")
    # A stage with +Z up is turned about X, as Blender and Houdini turn what they import and export.
    turn, up_axis = np.eye(4), str(UsdGeom.GetStageUpAxis(stage))
    if up_axis not in ("Y", "Z"):
        raise ValueError(f"its upAxis is {up_axis!r:.20}, and USD knows Y and Z")
    if up_axis == "Z":
        turn[1:3, 1:3] = [[0, 1], [-1, 0]]
    prims = [
        prim
        for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
        if prim.IsA(UsdGeom.Camera) and prim.IsActive()
    ]
    stems = [prim.GetName() for prim in prims]
    count = Counter(stems)
    names, lenses, matrices = [], [], []
    for prim, stem in zip(prims, stems, strict=True):
        if count[stem] > 1:  # Several cameras have this name, so the whole path names each.
            stem = str(prim.GetPath()).strip("/").replace("/", "_")
        camera, times = UsdGeom.Camera(prim), _sample_times(stage, prim)
        size = [(prim.GetAttribute(name).Get() if prim.HasAttribute(name) else 0) or 0 for name in USD_SIZE]
        for time in times:
            lens = camera.GetCamera(time)
            if camera.GetProjectionAttr().Get(time) == UsdGeom.Tokens.orthographic:
                raise ValueError(f"its camera {stem} is orthographic, and only perspective ones are rendered")
            offsets = lens.horizontalApertureOffset, lens.verticalApertureOffset
            moving = not time.IsDefault()
            names.append(f"{stem}_{time.GetValue():04.10g}" if moving else stem)
            lenses.append([*size, lens.focalLength, lens.horizontalAperture, lens.verticalAperture, *offsets])
            matrix = turn @ np.array(lens.transform, np.float64).T
            matrix[:3, 3] *= to_meters
            matrices.append(matrix)
    world = stage.GetRootLayer().customLayerData.get(USD_WORLD_MATRIX)
    world = np.zeros((4, 4)) if world is None else np.array(list(world), np.float64).reshape(4, 4)
    shapes = ("names", names, str, (-1,)), ("lenses", lenses, float, (-1, 7)), ("matrices", matrices, float, (-1, 4, 4))
    arrays = {name: np.array(values, kind).reshape(shape) for name, values, kind, shape in shapes}
    has_up_axis = stage.GetPseudoRoot().HasAuthoredMetadata(UsdGeom.Tokens.upAxis)
    return arrays | {"world_matrix": world, "up_stated": np.array(has_up_axis)}


def _sample_times(stage: Any, prim: Any) -> list[Any]:
    """Return the frames of a camera whose world transform or lens changes; the default time of one that stands."""
    Usd, UsdGeom = pxr("Usd"), pxr("UsdGeom")
    lens = ("focalLength", "horizontalAperture", "verticalAperture")
    lens += ("horizontalApertureOffset", "verticalApertureOffset")
    moving = [attribute for attribute in prim.GetAttributes() if attribute.GetName() in lens]
    ancestor = prim
    while ancestor and not ancestor.IsPseudoRoot():
        if ancestor.IsA(UsdGeom.Xformable):
            xformable = UsdGeom.Xformable(ancestor)
            moving += [operation.GetAttr() for operation in xformable.GetOrderedXformOps()]
            if xformable.GetResetXformStack():
                break
        ancestor = ancestor.GetParent()
    moving = [attribute for attribute in moving if attribute.GetNumTimeSamples() > 0]
    if not any(attribute.ValueMightBeTimeVarying() for attribute in moving):
        samples = sorted({time for attribute in moving for time in attribute.GetTimeSamples()})
        # A single sample holds at all times, but not at the default one.
        return [Usd.TimeCode(samples[0])] if samples and len(samples) == 1 else [Usd.TimeCode.Default()]
    if stage.HasAuthoredTimeCodeRange():
        first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
        if not 0 <= last - first < _MOST_FRAMES:
            raise ValueError(f"its time codes run from {first:g} to {last:g}")
        return [Usd.TimeCode(first + step) for step in range(int(last - first) + 1)]
    return [Usd.TimeCode(time) for time in sorted({t for attribute in moving for t in attribute.GetTimeSamples()})]


def _usd_camera(lens: np.ndarray, matrix: np.ndarray, path: Path, name: str) -> Camera:
    """Return the camera of a row of usd_camera_arrays; USD's camera axes are OpenGL's."""
    (width, height), (focal, aperture, vertical, right, up) = lens[:2], lens[2:].tolist()
    if not (focal > 0 and aperture > 0 and vertical > 0):
        raise ValueError(f"focal length {focal:g} and apertures {aperture:g} and {vertical:g} must be positive")
    width = int(width or _SIZE[0])
    height = int(height or round(width * vertical / aperture))
    fx, fy = focal / aperture * width, focal / vertical * height
    if np.linalg.det(matrix[:3, :3]) <= 0:
        raise ValueError("it is mirrored, or scaled to nothing, by itself or a parent")
    matrix = matrix.copy()
    matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)
    pose = pose_from_opengl(matrix, path, name)
    cx, cy = width / 2 - right / aperture * width, height / 2 + up / vertical * height
    return Camera(width, height, fx, fy, cx, cy, pose)


def _read_chan(path: Path) -> ExchangeCameras:
    """Read lines of frame, translation, rotation in degrees, and vertical field of view; 1920 x 1080 pixels."""
    from scipy.spatial.transform import Rotation

    cameras, (width, height) = [], _SIZE
    lines = read_text(path).splitlines()
    if len(lines) > _MOST_FRAMES:
        raise InputError(path, f"has {len(lines)} lines, more than {_MOST_FRAMES} frames", "render it in parts")
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            frame, x, y, z, rx, ry, rz, fov = (float(value) for value in line.replace(",", " ").split()[:8])
        except ValueError:
            problem = f"line {number} is not frame, 3 coordinates, 3 angles and the vertical field of view"
            raise InputError(path, problem, "export the camera with its field of view") from None
        if not (0 < fov < 180 and math.isfinite(x + y + z + rx + ry + rz) and abs(frame) < 1e9):
            problem = f"line {number} has field of view {fov:g} or coordinates out of range"
            raise InputError(path, problem, "export the camera again")
        matrix = np.eye(4)
        angles = {"x": rx, "y": ry, "z": rz}
        order = [angles[axis] for axis in CHAN_ROTATION]
        matrix[:3, :3] = Rotation.from_euler(CHAN_ROTATION, order, degrees=True).as_matrix()
        matrix[:3, 3] = x, y, z
        focal = height / 2 / math.tan(math.radians(fov) / 2)
        pose = pose_from_opengl(matrix, path, f"frame {frame:g}")
        name = f"{path.stem}_{frame:04.10g}"
        try:
            camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
        except ValueError as error:
            raise InputError(
                path, f"line {number} cannot be used ({error!s:.120})", "export the camera again"
            ) from None
        cameras.append((name, camera))
    return ExchangeCameras(cameras)
