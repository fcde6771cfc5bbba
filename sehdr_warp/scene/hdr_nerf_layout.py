"""Writes HDR truth as an HDR-NeRF synthetic set: photos at several exposures, poses, times and the truth."""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from .camera import Camera

DERIVED_PHOTOS = "reinhard-gamma"
"""What a set without photos of its own states as `photo_response`: load_scene makes them of the truth by this curve."""


@dataclass(frozen=True)
class RadianceView:
    """name: the view's stem (`r_0`); radiance: [H, W, 3] scene-linear, >= 0; split: "train" or "test".

    camera: its principal point is the centre and its focal lengths are equal, as the layout cannot say otherwise.
    """

    name: str
    camera: Camera
    radiance: np.ndarray
    split: str


def reinhard_gamma(exposure: np.ndarray) -> np.ndarray:
    """HDR-NeRF's synthetic response: (x / (1 + x))^(1 / 2.2), exposure x >= 0 -> [0, 1)."""
    exposure = np.maximum(exposure, 0.0)
    return (exposure / (1.0 + exposure)) ** (1 / 2.2)


def reinhard_gamma_inverse(value: np.ndarray) -> np.ndarray:
    """The exposure x >= 0 of an encoded value in [0, 1]; infinite at 1."""
    with np.errstate(divide="ignore"):
        linear = np.asarray(value, dtype=np.float64) ** 2.2
        return linear / (1.0 - linear)


def centred_exposures(radiance: Iterable[np.ndarray], count: int = 5, ratio: float = 4.0) -> list[float]:
    """`count` times, each `ratio` times the last, whose middle brings the median luminance to x = 0.28 (encoded 0.5
    by HDR-NeRF's response)."""
    weights = np.array([0.2126, 0.7152, 0.0722])
    median = float(np.median(np.concatenate([(image @ weights).ravel() for image in radiance])))
    middle = reinhard_gamma_inverse(np.array(0.5)) / median
    return [float(middle * ratio ** (k - (count - 1) / 2)) for k in range(count)]


def write_hdr_nerf_scene(
    folder: Path | str,
    views: Sequence[RadianceView],
    exposure_times: Sequence[float],
    encode: Callable[[np.ndarray], np.ndarray] = reinhard_gamma,
    *,
    exposures: Sequence[int] | None = None,
    points: tuple[np.ndarray, np.ndarray] | None = None,
    half: bool = True,
) -> None:
    """Write a set that load_scene reads, with HDR-NeRF's file names, into a folder that may exist but gets new files.

    exposure_times: seconds; photo k of a view is encode(radiance * exposure_times[k]) in 8 bits, rounded to nearest.
    exposures: the numbers k to write; None writes all.
    points: ([P, 3] places, [P, 3] colours in [0, 1]) for `sparse/0/points3D.txt`; None writes none.
    half: the truth as half floats (values up to 65504), otherwise as floats.
    Raises ValueError for a camera that the layout cannot hold, cameras that differ, or radiance beyond the format.
    """
    import OpenEXR

    folder = Path(folder)
    angles = {_view_angle(view.camera) for view in views}
    if len(angles) != 1:
        raise ValueError(f"HDR-NeRF sets have one camera_angle_x, the views have {sorted(angles)[:4]}")
    for split in ("train", "test"):
        chosen = [view for view in views if view.split == split]
        frames, times = [], {}
        (folder / split).mkdir(parents=True, exist_ok=True)
        (folder / f"{split}_hdr").mkdir(exist_ok=True)
        for place, view in enumerate(chosen):
            stem = f"./{split}/{view.name}"
            for k in range(len(exposure_times)) if exposures is None else exposures:
                value = np.clip(encode(view.radiance * exposure_times[k]), 0.0, 1.0)
                Image.fromarray((value * 255 + 0.5).astype(np.uint8)).save(folder / f"{stem}_{k}.png", optimize=True)
                times[f"{stem}_{k}.png"] = float(exposure_times[k])
            if half and view.radiance.max() > 65504:
                raise ValueError(f"radiance {view.radiance.max():g} of {view.name} does not fit half floats")
            pixels = np.ascontiguousarray(view.radiance, dtype=np.float16 if half else np.float32)
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, {"RGB": pixels}) as file:
                file.write(str(folder / f"{split}_hdr" / f"hdr_{place:03d}.exr"))
            matrix = view.camera.camera_to_world.copy()
            matrix[:3, 1:3] *= -1
            frames.append({"file_path": stem, "transform_matrix": matrix.tolist()})
        transforms = {"camera_angle_x": next(iter(angles)), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(transforms, indent=1))
        (folder / f"exposure_{split}.json").write_text(json.dumps(times, indent=1))
    if points is not None:
        (folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
        lines = ["# id x y z red green blue error track\n"]
        for i, (place, color) in enumerate(zip(*points, strict=True), start=1):
            code = np.clip(np.asarray(color) * 255 + 0.5, 0, 255).astype(int)
            lines.append(f"{i} {place[0]:.6g} {place[1]:.6g} {place[2]:.6g} {code[0]} {code[1]} {code[2]} 0\n")
        (folder / "sparse" / "0" / "points3D.txt").write_text("".join(lines))


def _view_angle(camera: Camera) -> float:
    centred = np.allclose([camera.cx, camera.cy], [camera.width / 2, camera.height / 2], atol=1e-6)
    if not centred or not np.isclose(camera.fx, camera.fy, rtol=1e-9):
        raise ValueError("HDR-NeRF sets have square pixels and a centred principal point")
    return 2 * math.atan(0.5 * camera.width / camera.fx)
