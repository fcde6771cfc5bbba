"""Cameras for other programs: an OpenUSD stage, Nuke's .chan file, and nerfstudio's camera path.

A path of cameras is one moving camera with a sample for each frame; other cameras stand side by side.
"""

import json
import math
import re
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ...scene import Camera
from ...scene.readers.camera_exchange import CHAN_ROTATION, USD_SIZE, USD_WORLD_MATRIX

_APERTURE = 36.0  # Of a full-frame camera, mm: USD's lens lengths are relative to it
_STAGE = """#usda 1.0
(
    customLayerData = {{
        double[] {world_key} = [{world}]
    }}
    defaultPrim = "Cameras"
{times}    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Cameras"
{{
{cameras}
}}
"""
_TIMES = """    endTimeCode = {last}
    framesPerSecond = {fps}
    startTimeCode = {first}
    timeCodesPerSecond = {fps}
"""
_CAMERA = """    def Camera "{name}"
    {{
        custom int {sizes[0]} = {width}
        custom int {sizes[1]} = {height}
        float2 clippingRange = (0.01, 1000000)
        float focalLength{focal}
        float horizontalAperture = {aperture!r}
        float verticalAperture{vertical}
        float horizontalApertureOffset{right}
        float verticalApertureOffset{up}
        matrix4d xformOp:transform{matrix}
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }}"""


class CameraPath(NamedTuple):
    """A moving camera."""

    name: str  # Of the camera
    frames: list[int]  # Frame numbers, ascending
    cameras: list[Camera]  # One for each frame


def camera_path(views: Sequence[tuple[str, Camera]]) -> CameraPath | None:
    """Return named cameras as one that moves; None if they are several.

    They are one if two or more have one size and names that end in consecutive numbers of three digits or more, such as
    orbit_000, orbit_001.
    """
    numbered = [re.fullmatch(r"(.*?)_?(\d{3,})", name) for name, _ in views]
    matches = [match for match in numbered if match]
    frames = [int(match[2]) for match in matches]
    sizes = {(camera.width, camera.height) for _, camera in views}
    if len(views) < 2 or len(matches) < len(views) or len(sizes) > 1 or len({match[1] for match in matches}) > 1:
        return None
    if any(after != before + 1 for before, after in pairwise(frames)):
        return None
    return CameraPath(matches[0][1] or "camera", frames, [camera for _, camera in views])


def usd_cameras(
    views: Sequence[tuple[str, Camera]], matrix: np.ndarray, *, path: CameraPath | None = None, fps: float = 24
) -> str:
    """Return the text of a stage with a UsdGeomCamera for each camera, or one with time samples for a path.

    The size in pixels, which USD does not have, is stored in attributes of this package, and the matrix in the stage's
    customLayerData.

    Args:
        views: Names and pinhole cameras in the file's coordinates.
        matrix: [4, 4] from the photos' coordinates to the file's.
        path: The same cameras as one that moves.
        fps: Frames a second of the path.
    """
    world = ", ".join(repr(float(value)) for value in matrix.ravel())
    if path is None:
        groups = zip(_identifiers([name for name, _ in views]), ([camera] for _, camera in views), strict=True)
        times = ""
        prims = [_usd_camera(name, cameras, None) for name, cameras in groups]
    else:
        times = _TIMES.format(first=path.frames[0], last=path.frames[-1], fps=f"{fps:.10g}")
        prims = [_usd_camera(_identifiers([path.name])[0], path.cameras, path.frames)]
    return _STAGE.format(world_key=f'"{USD_WORLD_MATRIX}"', world=world, times=times, cameras="\n".join(prims))


def chan_cameras(path: CameraPath) -> str:
    """Return a moving camera as Nuke's .chan: frame, translation, rotation in degrees, vertical field of view.

    The format has neither size nor principal point.
    """
    lines = []
    for frame, camera in zip(path.frames, path.cameras, strict=True):
        pose = _opengl(camera)
        angles = dict(zip(CHAN_ROTATION, Rotation.from_matrix(pose[:3, :3]).as_euler(CHAN_ROTATION, degrees=True)))
        fov = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
        values = [*pose[:3, 3], *(angles[axis] for axis in "xyz"), fov]
        lines.append(" ".join([str(frame), *(f"{value:.9g}" for value in values)]))
    return "\n".join(lines) + "\n"


def nerfstudio_path(cameras: Sequence[Camera], fps: float = 24) -> str:
    """Return a moving camera, in the photos' coordinates, as nerfstudio's camera_path.json.

    The format has no principal point.
    """
    entries = [
        {
            "camera_to_world": _opengl(camera).ravel().tolist(),
            "fov": math.degrees(2 * math.atan(camera.height / 2 / camera.fy)),
            "aspect": camera.width / camera.height,
        }
        for camera in cameras
    ]
    values = {
        "camera_type": "perspective",
        "render_width": cameras[0].width,
        "render_height": cameras[0].height,
        "fps": fps,
        "seconds": len(entries) / fps,
        "camera_path": entries,
    }
    return json.dumps(values, indent=1) + "\n"


def _usd_camera(name: str, cameras: Sequence[Camera], frames: Sequence[int] | None) -> str:
    """Return the text of one camera: values, or a sample for each frame."""

    def values(texts: list[str]) -> str:
        if frames is None or len(set(texts)) == 1:
            return f" = {texts[0]}"
        lines = "".join(f"            {frame}: {text},\n" for frame, text in zip(frames, texts, strict=True))
        return f".timeSamples = {{\n{lines}        }}"

    first = cameras[0]
    focal = [camera.fx / camera.width * _APERTURE for camera in cameras]
    vertical = [f * camera.height / camera.fy for f, camera in zip(focal, cameras, strict=True)]
    right = [(0.5 - camera.cx / camera.width) * _APERTURE for camera in cameras]
    up = [(camera.cy / camera.height - 0.5) * v for v, camera in zip(vertical, cameras, strict=True)]
    # USD's matrices act on row vectors.
    rows = [_opengl(camera).T for camera in cameras]
    matrices = [", ".join("(" + ", ".join(repr(float(v)) for v in row) + ")" for row in matrix) for matrix in rows]
    return _CAMERA.format(
        name=name,
        sizes=USD_SIZE,
        width=first.width,
        height=first.height,
        aperture=_APERTURE,
        focal=values([repr(float(v)) for v in focal]),
        vertical=values([repr(float(v)) for v in vertical]),
        right=values([repr(float(v)) for v in right]),
        up=values([repr(float(v)) for v in up]),
        matrix=values([f"( {matrix} )" for matrix in matrices]),
    )


def _opengl(camera: Camera) -> np.ndarray:
    """Return [4, 4] camera to world in OpenGL's axes: +y up, -z forward."""
    return camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])


def _identifiers(names: Sequence[str]) -> list[str]:
    """Return names of prims: letters, digits and `_`, all different."""
    identifiers: list[str] = []
    for name in names:
        plain = re.sub(r"^(?=\d)", "_", re.sub(r"\W", "_", name, flags=re.ASCII)) or "camera"
        numbered = (plain if number == 1 else f"{plain}_{number}" for number in range(1, len(names) + 2))
        identifiers.append(next(each for each in numbered if each not in identifiers))
    return identifiers
