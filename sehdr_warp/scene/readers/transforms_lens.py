"""Lenses that transforms.json states, for the whole file or by frame (nerfstudio, instant-ngp, Blender)."""

import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from ...errors import InputError
from ..lens import Lens
from ..photos import photo_sizes

_REMEDY = "correct the file or export it again"
_MODELS = "use camera_model OPENCV, OPENCV_FISHEYE, PINHOLE or EQUIRECTANGULAR"
_FISHEYE = ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "FISHEYE")
_OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular", "orthographic")  # Of instant-ngp
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # Order of nerfstudio's distortion_params
_FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "FULL_OPENCV", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")


def frame_lens(values: dict, frame: dict, image: Path | None, path: Path) -> Lens:
    """Return the lens of a frame, whose values win over the file's; the photo's size counts if neither states one.

    Raises:
        InputError: if values are missing or not possible.
    """
    fields = values | frame
    if isinstance(bent := fields.get("distortion_params"), list):  # nerfstudio's other spelling
        fields |= dict(zip(_DISTORTION, bent, strict=False))
    if all(fields.get(name) is None for name in _FOCAL):
        with suppress(KeyError, TypeError, ValueError):  # The matrix of intrinsics, as of RealityCapture's converters
            (fx, _, cx), (_, fy, cy), _ = fields["K"]
            matrix = {"fl_x": float(fx), "fl_y": float(fy), "cx": float(cx), "cy": float(cy)}
            fields |= {name: value for name, value in matrix.items() if fields.get(name) is None}

    def number(key: str, absent: Any = None) -> Any:
        value = fields.get(key)
        if value is None:
            return absent
        with suppress(ValueError):
            value = float(value) if isinstance(value, str) else value
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
            raise InputError(path, f"{key} = {value!r:.40} is not a finite number", _REMEDY)
        return float(value)

    def focal(key: str, angle_key: str, length: float) -> Any:
        # instant-ngp's x_fov and y_fov are in degrees.
        angle = number(angle_key) or math.radians(number(f"{angle_key[-1]}_fov", 0.0))
        return number(key, 0.5 * length / math.tan(0.5 * angle) if 1e-9 < angle < math.pi else None)

    width, height = number("w"), number("h")
    if width is None or height is None:
        if image is None:
            raise InputError(path, "states no image size", "add w and h")
        width, height = photo_sizes(image)[0]
    if str(fields.get("camera_model")).upper() in ("EQUIRECTANGULAR", "SPHERICAL"):
        return Lens("EQUIRECTANGULAR", int(width), int(height), (width, height), path)
    model, bent = _distortion(fields, number, path)
    fx, fy = focal("fl_x", "camera_angle_x", width), focal("fl_y", "camera_angle_y", height)
    if fx is None and fy is None:
        raise InputError(path, "states no focal length", "add camera_angle_x (radians, below pi) or fl_x (pixels)")
    center = number("cx", width / 2), number("cy", height / 2)
    pinhole: tuple[Any, ...] = fy if fx is None else fx, fx if fy is None else fy, *center
    return Lens(model, int(width), int(height), (*pinhole, *bent), path)


def _distortion(fields: dict, number: Callable[..., Any], path: Path) -> tuple[str, tuple[float, ...]]:
    """Return the lens model of a frame and its parameters behind focal lengths and center.

    Args:
        fields: of the frame and the file.
        number: returns the number of a field, or its second argument if there is none.
        path: the file.

    Raises:
        InputError: for a model that is not supported, or parameters whose meaning the model does not say.
    """
    if other := next((name for name in _OTHER_LENSES if fields.get(name)), None):
        raise InputError(path, f"states a lens by {other}, which is not read", _MODELS)
    k1, k2, k3, k4, k5, k6, p1, p2 = (number(key, 0.0) for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"))
    model = str(fields.get("camera_model") or "OPENCV").upper()
    if model in _FISHEYE or fields.get("is_fisheye") is True:
        return "OPENCV_FISHEYE", (k1, k2, k3, k4)
    if model not in _PERSPECTIVE:
        problem = f"camera_model {fields['camera_model']!r:.40} is not supported"
        raise InputError(path, problem, _MODELS)
    if model != "FULL_OPENCV" and (k4 or k5 or k6):
        # nerfstudio counts k4 as one more term of the polynomial, OpenCV and COLMAP as the first of a quotient.
        name, value = next(pair for pair in (("k4", k4), ("k5", k5), ("k6", k6)) if pair[1])
        problem = f"{name} = {value} of camera_model {model} has no one meaning"
        raise InputError(path, problem, "state camera_model FULL_OPENCV for OpenCV's, or undistort the images first")
    if k3 or k4 or k5 or k6:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, k4, k5, k6)
    return "OPENCV", (k1, k2, p1, p2)
