"""The cameras of a render as an OpenUSD stage in text, by which Blender, Nuke and Houdini line a shot up with it."""

import re
from collections.abc import Sequence

import numpy as np

from sehdr_warp.scene import Camera
from sehdr_warp.scene.camera_files import USD_SIZE

_APERTURE = 36.0  # Of a full-frame camera, mm: USD's lens lengths are relative to it
_STAGE = """#usda 1.0
(
    defaultPrim = "Cameras"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Cameras"
{{
{cameras}
}}
"""
_CAMERA = """    def Camera "{name}"
    {{
        custom int {sizes[0]} = {width}
        custom int {sizes[1]} = {height}
        float2 clippingRange = (0.01, 1000000)
        float focalLength = {focal!r}
        float horizontalAperture = {aperture!r}
        float verticalAperture = {vertical!r}
        float horizontalApertureOffset = {right!r}
        float verticalApertureOffset = {up!r}
        matrix4d xformOp:transform = ( {rows} )
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }}"""


def usd_cameras(cameras: Sequence[tuple[str, Camera]]) -> str:
    """Return the text of a stage with one UsdGeomCamera for each camera.

    The size in pixels, which USD does not have, is stored in attributes of this package.
    """
    return _STAGE.format(cameras="\n".join(map(_described, _identifiers([name for name, _ in cameras]), cameras)))


def _described(name: str, named: tuple[str, Camera]) -> str:
    camera = named[1]
    focal = camera.fx / camera.width * _APERTURE
    vertical = focal * camera.height / camera.fy
    # OpenGL's axes, and matrices that act on row vectors.
    matrix = (camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])).T
    lens = {"focal": focal, "aperture": _APERTURE, "vertical": vertical}
    lens |= {"right": (0.5 - camera.cx / camera.width) * _APERTURE, "up": (camera.cy / camera.height - 0.5) * vertical}
    rows = ", ".join("(" + ", ".join(repr(float(value)) for value in row) + ")" for row in matrix)
    return _CAMERA.format(name=name, sizes=USD_SIZE, width=camera.width, height=camera.height, rows=rows, **lens)


def _identifiers(names: Sequence[str]) -> list[str]:
    """Return names of prims: letters, digits and `_`, all different."""
    identifiers: list[str] = []
    for name in names:
        plain = re.sub(r"^(?=\d)", "_", re.sub(r"\W", "_", name, flags=re.ASCII))
        numbered = (plain if number == 1 else f"{plain}_{number}" for number in range(1, len(names) + 2))
        identifiers.append(next(each for each in numbered if each not in identifiers))
    return identifiers
