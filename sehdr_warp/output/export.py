"""A trained scene as a file of Gaussians: what viewers show, or scene-linear radiance; what is lost is measured."""

import json
import logging
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.scene import Camera
from sehdr_warp.scene.exposure import shutter

from ..files import atomic_path, check_absent
from ..model.baking import agreement, gaussians_of, refine
from ..splats import check_suffix, color_model_of, write_gaussians

log = logging.getLogger(__name__)
KINDS = ("ldr", "hdr")
_JUDGED = 8  # Views that tell what a file kept
_DARKER = 4  # Stops below the photos' exposure, where light above their white shows


def export(
    run: Any,
    path: Path | str,
    *,
    kind: str | None = None,
    exposure_time: float | None = None,
    degree: int | None = None,
    cameras: bool = False,
    overwrite: bool = False,
) -> Path:
    """Write the Gaussians of a trained run; return the path.

    How well the file keeps the scene is measured on pictures and logged.

    Args:
        run: From load_run, train or load_splats.
        path: The file; its suffix decides: .ply, .glb (glTF), .usda, .usdc, .usdz (OpenUSD).
        kind: "ldr" for the colors of a photo, which viewers show, refined to the run's own pictures; "hdr" for
            scene-linear radiance. None: hdr for USD, else ldr.
        exposure_time: Seconds, of ldr colors; by default the scene's.
        degree: Pad harmonics with zeros up to this degree, for readers that take no other; at most 3.
        cameras: Also write `cameras.json` beside it, as the reference release of 3D Gaussian Splatting does.
        overwrite: Replace files that exist.

    Raises:
        SehdrError: For options that do not fit.
        InputError: For an unknown suffix, if a file exists, or if a value is not finite.
    """
    path = Path(path)
    held = color_model_of(path)
    kind = kind or ("hdr" if held == "linear" else "ldr")
    _check(path, kind, held, exposure_time, degree)
    beside = path.with_name("cameras.json")
    for file in (path, *[beside] * cameras):
        check_absent(file, overwrite)  # Before minutes of fitting.
    photos = [entry.camera for entry in run.cameras if entry.split == "train"]
    positions = np.array([camera.position for camera in photos]).reshape(-1, 3)
    if kind == "ldr":
        time = run.base_time if exposure_time is None else float(exposure_time)
        gaussians = gaussians_of(run.model, "display", positions, time, run.color_matrix)
        if gaussians.color_model != run.model.color_model.name:
            gaussians = refine(gaussians, _photographed(run, time), photos)
    else:
        color_model = held or ("linear" if run.model.color_model.name == "linear" else "log")
        gaussians = gaussians_of(run.model, color_model, positions, color_matrix=run.color_matrix)
    gaussians = gaussians.padded(degree or 0)
    write_gaussians(path, gaussians, overwrite=overwrite)
    if cameras:
        _write_cameras(beside, run, overwrite)
    _tell(path, run, gaussians, kind, exposure_time)
    return path


def _check(path: Path, kind: str, held: str | None, exposure_time: float | None, degree: int | None) -> None:
    if kind not in KINDS:
        raise SehdrError(f"kind {kind!r} is not one of {', '.join(KINDS)}")
    if held not in (None, "linear" if kind == "hdr" else "display"):
        limit = "is tagged as scene-linear" if held == "linear" else "knows display colors only"
        raise InputError(path, f"{check_suffix(path)} {limit}, and kind {kind} is not", "leave the kind out")
    if exposure_time is not None and kind == "hdr":
        raise SehdrError("an HDR file has no exposure time; leave it out, or write kind ldr")
    if exposure_time is not None and not 0 < exposure_time < math.inf:
        raise SehdrError(f"exposure time {exposure_time:g} is not positive and finite; give seconds")
    if degree is not None and not 0 <= degree <= 3:
        raise SehdrError(f"harmonics of degree {degree} cannot be; give 0 to 3")


def _tell(path: Path, run, gaussians, kind: str, exposure_time: float | None) -> None:
    time = exposure_time or run.base_time
    meaning = f"display colors of {shutter(time)}" if kind == "ldr" else "scene-linear radiance"
    log.info("%s: %d Gaussians, harmonics of degree %d, %s", path.name, gaussians.count, gaussians.degree, meaning)
    views = _judged(run)
    where = f"{len(views)} view{'s' * (len(views) != 1)}"
    if not views:
        log.info("it is not compared with the scene, which has no cameras of its own")
    elif kind == "ldr":
        kept = agreement(gaussians, _photographed(run, time), views, time)
        log.info("kept: %.1f dB of the scene's own pictures in %s; lost: light above white", kept, where)
    else:
        dark = time / 2**_DARKER
        kept = [agreement(gaussians, _shown(run, t), views, t) for t in (time, dark)]
        log.info("kept: %.1f dB of the scene at 0 EV, %.1f dB at -%d EV, in %s", *kept, _DARKER, where)


def _judged(run) -> Sequence[Camera]:
    held_out = [entry.camera for entry in run.cameras if entry.split == "test"]
    views = held_out or [entry.camera for entry in run.cameras]
    return views[:: -(-len(views) // _JUDGED) or 1]


def _photographed(run, time: float) -> Callable:
    """Return a function that renders simulated photos, or light for a scene in a sensor's colors."""
    return _shown(run, time) if run.color_matrix is not None else lambda camera: run.render_ldr(camera, time)


def _shown(run, time: float) -> Callable:
    """Return a function that renders radiance at an exposure time, encoded by sRGB."""
    from ..response import response_by_name

    encode = response_by_name("srgb").encode
    return lambda camera: encode(run.render(camera).hdr * time)


def _write_cameras(path: Path, run, overwrite: bool) -> None:
    described = []
    for index, entry in enumerate(run.cameras):
        camera, pose = entry.camera, entry.camera.camera_to_world
        size = {"width": camera.width, "height": camera.height}
        place = {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}
        described.append({"id": index, "img_name": entry.name, **size, **place, "fy": camera.fy, "fx": camera.fx})
    with atomic_path(path, overwrite) as temporary:
        temporary.write_text(json.dumps(described), encoding="utf-8")
