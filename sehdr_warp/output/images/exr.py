"""Scene-linear pictures: OpenEXR, single and multi-part, with the metadata that HDR tools read; and Radiance HDR.

In every OpenEXR file that this package writes, a color pixel is radiance times `expTime`, 1 in a picture of radiance.
docs/formats.md lists the attributes and the conventions of the matrices.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...errors import NOT_FINITE_REMEDY, InputError, SehdrError
from ...files import atomic_path
from ...scene import Camera
from .colorspace import chromaticities, color_space
from .ldr_files import EXIF_TIME

_TYPES = {"half": np.float16, "float": np.float32}
# OpenCV axes (+y down, +z forward) to the axes of worldToCamera (+y up, -z forward).
_FLIP_Y_Z = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Part:
    """One picture of a file."""

    channels: Mapping[str, np.ndarray]  # Name -> [H, W] finite numbers, all of one shape: R, G, B, A, Z, and any other
    header: Mapping[str, Any] = field(default_factory=dict)  # Attributes such as exr_header() returns
    name: str = ""  # Unique in the file; may be empty if the file has one part


def exr_header(
    colorspace: str = "rec709",
    exposure_time: float | None = None,
    camera: Camera | None = None,
    captured: datetime | None = None,
    provenance: Mapping[str, str] | None = None,
    white_luminance: float | None = None,
) -> dict[str, Any]:
    """Return OpenEXR attributes for a picture.

    Args:
        colorspace: Primaries of the pixels.
        exposure_time: Seconds that radiance was multiplied by.
        camera: Camera of the picture.
        captured: Local time that the file states as that of the picture.
        provenance: Text by key, written as `sehdr:<key>`.
        white_luminance: cd/m^2 of a value of 1 in R, G and B.
    """
    space = color_space(colorspace)
    header: dict[str, Any] = {"chromaticities": chromaticities(space.name), "sehdr:colorSpace": space.name}
    if space.interop_id:
        header["colorInteropID"] = space.interop_id
    if exposure_time is not None:
        header["expTime"] = float(exposure_time)
        header["sehdr:exposureTime"] = repr(float(exposure_time))  # expTime holds only 24 bits of it.
    if camera is not None:
        header.update(_camera_attributes(camera))
    if captured is not None:
        header["capDate"] = captured.strftime(EXIF_TIME)
    if white_luminance is not None:
        header["whiteLuminance"] = float(white_luminance)
    return header | {f"sehdr:{key}": str(value) for key, value in (provenance or {}).items()}


def as_data(header: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a picture's part, for a part that holds no colors."""
    colors = ("chromaticities", "whiteLuminance", "sehdr:colorSpace", "colorInteropID")
    return {key: value for key, value in header.items() if key not in colors} | {"colorInteropID": "data"}


def rgb_channels(image: np.ndarray) -> dict[str, np.ndarray]:
    """Return R, G and B of [H, W, 3]."""
    return dict(zip("RGB", np.moveaxis(image, 2, 0), strict=True))


PAST_HALF = "float, since half would overflow 65504"  # Value of `sehdr:pixelType` where half was asked for


def check_pixel_type(pixel: str) -> None:
    """Raise SehdrError unless a pixel type is "half" or "float"."""
    if pixel not in _TYPES:
        raise SehdrError(f"pixel type {pixel!r} is not one of {', '.join(_TYPES)}")


def stored_pixel_type(arrays: Sequence[np.ndarray], pixel: str = "half") -> str:
    """Return the type that holds all values unclipped: `pixel`, or "float" if half would overflow."""
    check_pixel_type(pixel)
    fits = all(np.abs(array).max() <= np.finfo(np.float16).max for array in arrays)
    return "half" if pixel == "half" and fits else "float"


def write_exr(path: Path | str, channels: Mapping[str, np.ndarray], *, header: Any = None, **options: Any) -> str:
    """Write a file with one unnamed part; header as in Part, options as in write_multipart_exr()."""
    return write_multipart_exr(path, [Part(channels, header or {})], **options)


def write_multipart_exr(
    path: Path | str, parts: Sequence[Part], *, pixel: str = "half", overwrite: bool = False
) -> str:
    """Write parts into one file and return the pixel type of the colors.

    Args:
        path: The file.
        parts: At least one, with different names.
        pixel: "half" or "float". If half cannot hold a value (above 65504 in size), all channels of the file are float
            instead, and each part's `sehdr:pixelType` says so: nothing is clipped. Depth (`Z`, or a layer's `.Z`) and
            positions are always float, because half's 11 bits are too few for them.
        overwrite: Replace a file that exists.

    Raises:
        InputError: If a value is NaN or infinite (with channel and place), or `path` exists.
        SehdrError: If the file cannot be written, or for an unknown pixel type.
        ValueError: For unequal shapes, or repeated names.
    """
    import OpenEXR

    path = Path(path)
    if not parts or len({part.name for part in parts}) < len(parts):
        raise ValueError("parts need one name each, all different")
    for part in parts:
        _check(path, part)
    colors = [array for part in parts for name, array in part.channels.items() if not _is_depth(name)]
    pixel_type = stored_pixel_type(colors, pixel)
    exr_parts = []
    for part in parts:
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "software": f"sehdr-warp {__version__}",
            "sehdr:version": __version__,
            "sehdr:pixelType": pixel_type if pixel_type == pixel else PAST_HALF,
            **part.header,
        }
        types = {name: np.float32 if _is_depth(name) else _TYPES[pixel_type] for name in part.channels}
        channels = {name: np.ascontiguousarray(array, types[name]) for name, array in part.channels.items()}
        exr_parts.append(OpenEXR.Part(header, channels, *filter(None, [part.name])))
    with atomic_path(path, overwrite) as temporary:
        try:
            with OpenEXR.File(exr_parts) as file:
                file.write(str(temporary))
        except (RuntimeError, ValueError, TypeError) as error:
            reason = " ".join(str(error).replace(str(temporary), path.name).split())
            raise SehdrError(f"{path}: cannot be written as OpenEXR ({reason}); check the disk's free space") from error
    return pixel_type


def _check(path: Path, part: Part) -> None:
    shapes = {np.shape(array) for array in part.channels.values()}
    if len(shapes) != 1 or any(len(shape) != 2 or 0 in shape for shape in shapes):
        raise ValueError(f"channels have the shapes {sorted(shapes)}, not one [H, W]")
    for name, array in part.channels.items():
        where = f"part {part.name}, " * bool(part.name) + f"channel {name}"
        check_finite(path, np.asarray(array), f"{where}: {{count}} values")
        if (largest := np.abs(array).max()) > np.finfo(np.float32).max:
            raise InputError(path, f"{where} reaches {largest:.3g}, past 32-bit floats", "scale the radiance down")


def check_finite(path: Path, image: np.ndarray, what: str) -> None:
    """Raise InputError if [H, W] or [H, W, 3] holds NaN or infinity.

    Args:
        path: File that the picture is for.
        image: The picture.
        what: Name of the values in the message, with {count} for how many are affected.
    """
    bad = ~np.isfinite(image)
    if bad.any():
        y, x, *channel = place = tuple(np.argwhere(bad)[0])
        first = f"{'RGB'[channel[0]]} = {image[place]}" if channel else image[place]
        fault = f"{what.format(count=int(bad.sum()))} are not finite, the first {first} at x={x}, y={y}"
        raise InputError(path, fault, NOT_FINITE_REMEDY)


def _is_depth(name: str) -> bool:
    """Return whether a channel holds depth, distance or positions, for which half is too coarse."""
    return name in ("Z", "distance.Z") or name.startswith("position.")


def _camera_attributes(camera: Camera) -> dict[str, Any]:
    """Return a camera as OpenEXR attributes; matrices act on row vectors (p M), as all of OpenEXR's do."""
    attributes: dict[str, Any] = {
        "worldToCamera": np.ascontiguousarray((_FLIP_Y_Z @ camera.world_to_camera).T, np.float32),
        "sehdr:camera": json.dumps(camera.to_dict()),
    }
    if not camera.is_pinhole:
        return attributes  # OpenEXR's other attributes describe a screen, which a sphere or a fisheye has not.
    # x and y run over [0, 1] from the top left corner; z is the distance along the axis; w divides.
    to_ndc = np.zeros((4, 4))
    to_ndc[0, [0, 2]] = np.array([camera.fx, camera.cx]) / camera.width
    to_ndc[1, [1, 2]] = np.array([camera.fy, camera.cy]) / camera.height
    to_ndc[2:, 2] = 1
    # The screen window lies at distance 1; its axes point to the camera's left and up.
    center = ((camera.cx - camera.width / 2) / camera.fx, (camera.cy - camera.height / 2) / camera.fy)
    return attributes | {
        "worldToNDC": np.ascontiguousarray((to_ndc @ camera.world_to_camera).T, np.float32),
        "screenWindowCenter": np.array(center, np.float32),
        "screenWindowWidth": camera.width / camera.fx,
        "pixelAspectRatio": camera.fy / camera.fx,
    }


def write_radiance(
    path: Path | str, image: np.ndarray, *, exposure: float = 1.0, colorspace: str = "rec709", overwrite: bool = False
) -> None:
    """Write [H, W, 3] linear RGB as Radiance HDR; negative values become 0 and channels share an 8-bit exponent.

    Args:
        path: The file.
        image: The picture.
        exposure: Factor that radiance was multiplied by, written as EXPOSURE.
        colorspace: Primaries of the picture, written as PRIMARIES unless they are Rec.709's, which programs expect.
        overwrite: Replace a file that exists.

    Raises:
        InputError: If a value is NaN or infinite (with its place) or `path` exists.
    """
    check_finite(Path(path), image, "{count} values")
    image = np.clip(np.asarray(image, np.float64), 0, 1.7e38)
    largest = image.max(axis=2)
    mantissa, exponent = np.frexp(largest)
    scale = np.where(largest > 1e-32, mantissa * 256 / np.where(largest > 0, largest, 1), 0)
    codes = np.concatenate(
        [np.floor(image * scale[..., None]), (exponent + 128)[..., None] * (scale > 0)[..., None]], 2
    )
    height, width = largest.shape
    lines = "" if exposure == 1 else f"EXPOSURE={exposure:.9g}\n"
    if color_space(colorspace).name != "rec709":
        lines += f"PRIMARIES={' '.join(f'{value:.6g}' for value in chromaticities(colorspace))}\n"
    head = f"#?RADIANCE\nSOFTWARE=sehdr-warp\n{lines}FORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    with atomic_path(path, overwrite) as temporary:
        temporary.write_bytes(head.encode() + codes.astype(np.uint8).tobytes())
