"""A trained scene as a file of Gaussians: what viewers show, or scene-linear radiance; what is lost is measured."""

import json
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path

import numpy as np

from ...errors import InputError, SehdrError, path_of, require_loaded, require_whole_number
from ...files import atomic_path
from ...model.baking import field_of, fit_to_pictures, gaussians_of, psnr_of, with_photo_filters
from ...response import response_by_name
from ...runs.run import RenderableScene, on_device
from ...scene.camera_focus import camera_positions
from ...scene.exposure.times import shutter
from ...splats import (
    STREAMED_SOG,
    GaussianArrays,
    camera_file_of,
    check_new_file,
    check_suffix,
    path_is_lossy,
    read_gaussians,
    required_color_model,
    write_gaussians,
)
from ...subsets import every_nth, first_names
from ..brackets import remove_earlier
from ..cameras.scene_cameras import split_or_all, training_cameras
from ..images.display import display_gain
from ..world_transform import WorldTransform, file_transform, is_y_down, photos_to_file, world_transform
from .splat_edits import SplatEdits, most_visible, without_strays

log = logging.getLogger(__name__)
KINDS = ("ldr", "hdr")
_MAX_COMPARED = 8  # Views in which a file is compared with the scene
_DARKER = 4  # Stops below the photos' exposure, where light above their white shows
_WORDS = ((42.0, "no visible loss"), (36.0, "close copy"), (30.0, "small differences"))  # From this many dB on


def export(
    run: RenderableScene,
    path: Path | str,
    *,
    kind: str | None = None,
    exposure_time: float | None = None,
    degree: int | None = None,
    cameras: bool = False,
    axes: str | None = "upright",
    up: str | Sequence[float] | None = None,
    scale: float | None = None,
    edits: SplatEdits | None = None,
    overwrite: bool = False,
) -> Path:
    """Write the Gaussians of a trained run; return the path.

    How well the file keeps the scene is measured on pictures and logged. Harmonics by suffix and kind:

    suffix          kind   color model                   harmonics are fitted, unless the run has
    .ply            ldr    display                       display colors of this exposure
    .ply            hdr    linear as the run, else log   linear or log colors without fusion
    USD             hdr    linear                        linear colors without fusion
    .glb and small  ldr    display                       display colors of this exposure

    Args:
        run: From load_run, train, load_splats or merge_scenes.
        path: The file; its suffix decides: see sehdr_warp.splats.SUFFIXES.
        kind: "ldr" for the colors of a photo, which viewers show, refined to the run's own pictures; "hdr" for
            scene-linear radiance. None: hdr for USD, else ldr.
        exposure_time: Seconds, of ldr colors; by default the scene's.
        degree: Pad harmonics with zeros up to this degree, for readers that take no other; at most 3.
        cameras: Also write `<name>.cameras.json` beside it (scene.ply.cameras.json), in the form of the reference
            release of 3D Gaussian Splatting.
        axes: "upright" or "scene" (see world_transform); None keeps the coordinates of a file of Gaussians, and only
            turns them over if one file has +Y up and the other -Y.
        up: As in world_transform.
        scale: As in world_transform.
        edits: What the file leaves out; by default Gaussians too faint to be drawn.
        overwrite: Replace files that exist, and without `cameras` remove those that an earlier export wrote beside,
            unless the run is the file at `path` and keeps its coordinates.

    Raises:
        SehdrError: For options that do not fit, or edits that leave nothing.
        InputError: For an unknown suffix, if a file exists, or if a value is not finite.
    """
    require_loaded("load_run", run)
    path, edits = path_of(path, "path"), SplatEdits() if edits is None else edits
    if not isinstance(edits, SplatEdits):
        raise TypeError(f"edits is a {type(edits).__name__}, expected SplatEdits, such as SplatEdits(min_views=2)")
    file_model = required_color_model(path)
    kind = kind or ("hdr" if file_model == "linear" else "ldr")
    _check(path, kind, file_model, exposure_time, degree)
    check_new_file(path, cameras=cameras, overwrite=overwrite)  # Before minutes of fitting
    if cameras and not any(entry.camera.is_pinhole for entry in run.cameras):
        raise SehdrError(f"{run.path}: has no cameras, or none that is a pinhole, to write; leave --cameras out")
    # Regions of edits are in the coordinates of `axes`, before a file with -Y up is turned over.
    to_axes = _turned(run, path) if axes is None else world_transform(run, axes, up=up, scale=scale)
    to_file = file_transform(to_axes, path) if axes == "upright" else to_axes
    exposure_time = run.base_time if exposure_time is None else float(exposure_time)
    # Colors that are converted to Rec.709 are encoded by sRGB, at the exposure that shows middle grey as the photos do.
    display_time = exposure_time * (1.0 if run.color_matrix is None else display_gain(run.response))
    hdr_model = file_model or ("linear" if run.field.color_model.name == "linear" else "log")
    means = run.field.gaussians.means.detach().cpu().numpy()
    edits.check_regions(to_axes.points(run.field.normalization.scene_points(means)))  # Before minutes of fitting
    # All Gaussians of the scene, then those that edits leave; both in the scene's coordinates.
    gaussians = _gaussians_in_colors(run, "display" if kind == "ldr" else hdr_model, display_time)
    gaussians = with_photo_filters(gaussians, training_cameras(run))
    mask = edits.mask(gaussians.opacities, to_axes.points(gaussians.means), run)
    edited = _select_rows(run, gaussians, mask, edits, display_time)
    in_file = edited if to_file.is_identity else edited.transformed(to_file.matrix)
    if run.world_matrix is not None:
        in_file = replace(in_file, world_matrix=photos_to_file(run, to_file))
    in_file = in_file.padded(degree or 0)
    write_gaussians(path, in_file, overwrite=overwrite)
    if cameras:
        _write_cameras(camera_file_of(path), run, to_file, overwrite)
    elif overwrite and not (to_file.is_identity and Path(run.path).resolve() == path.resolve()):
        # Cameras of an earlier export would count as these Gaussians'. Those of a file edited in place still fit it.
        remove_earlier(path.parent, [camera_file_of(path).name])
    meaning = f"display colors of {shutter(exposure_time)}" if kind == "ldr" else "scene-linear radiance"
    log.info("%s: %d Gaussians, harmonics of degree %d, %s", path.name, in_file.count, in_file.degree, meaning)
    compared, note = (gaussians, ", before the cut") if edits.shows_part else (edited, "")
    _log_loss(run, compared, kind, display_time, note)
    if path_is_lossy(path):
        _log_file_loss(path, run, edited if edits.shows_part else None, to_file, display_time)
    return path


def _turned(run: RenderableScene, path: Path) -> WorldTransform:
    """Return the half turn that a file with +Y up and one with -Y up differ by; the identity between files alike."""
    turn = np.diag([-1.0, -1.0, 1.0]) if is_y_down(run.path) != is_y_down(path) else np.eye(3)
    return WorldTransform(turn, np.zeros(3))


def _select_rows(
    run: RenderableScene, gaussians: GaussianArrays, mask: np.ndarray, edits: SplatEdits, display_time: float
) -> GaussianArrays:
    """Return the Gaussians of a mask without strays; the most visible, fitted to pictures, if they are too many."""
    part, most = gaussians.rows(mask), edits.max_gaussians
    if most is not None and part.count > most:
        subset = gaussians.rows(most_visible(mask, most, run))
        # The fit must not bring back what an edit removed, floaters included.
        picture = (
            _splat_renderer(part, run, display_time) if edits.changes_pictures else _photo_renderer(run, display_time)
        )
        part = fit_to_pictures(subset, picture, training_cameras(run)) if gaussians.color_model == "display" else subset
    return without_strays(part, training_cameras(run))


def _gaussians_in_colors(run: RenderableScene, color_model: str, display_time: float) -> GaussianArrays:
    """Return the Gaussians of a run in the scene's coordinates and in the colors of a file.

    Display colors are those of a photo of `display_time` seconds.
    """
    photos = training_cameras(run)
    positions = camera_positions(photos)
    if color_model != "display":
        return gaussians_of(run.field, color_model, positions, color_matrix=run.color_matrix)
    if run.field.color_model.name == "display" and display_time == run.base_time and run.color_matrix is None:
        return gaussians_of(run.field, "display", positions)
    if run.is_paged:
        problem = f"does not fit into {run.device}, on which display colors are fitted to pictures"
        raise SehdrError(f"{run.path}: {problem}; use --device cpu, or kind hdr in a .ply")
    gaussians = gaussians_of(run.field, "display", positions, display_time, run.color_matrix)
    return fit_to_pictures(gaussians, _photo_renderer(run, display_time), photos)


def _check(path: Path, kind: str, file_model: str | None, exposure_time: float | None, degree: int | None) -> None:
    if kind not in KINDS:
        raise SehdrError(f"kind {kind!r} is not one of {', '.join(KINDS)}")
    if file_model not in (None, "linear" if kind == "hdr" else "display"):
        limit = "is tagged as scene-linear" if file_model == "linear" else "knows display colors only"
        raise InputError(path, f"{check_suffix(path)} {limit}, and kind {kind} is not", "leave the kind out")
    if exposure_time is not None and kind == "hdr":
        raise SehdrError("an HDR file has no exposure time; leave it out, or write kind ldr")
    if exposure_time is not None and not (isinstance(exposure_time, Real) and 0 < exposure_time < math.inf):
        raise SehdrError(f"exposure time {exposure_time!r:.60} is not positive and finite; give seconds")
    if degree is not None:
        require_whole_number(degree, "degree")
    if degree is not None and not 0 <= degree <= 3:
        raise SehdrError(f"harmonics of degree {degree} are not supported; give 0 to 3")


def loss_in_words(decibels: float) -> str:
    """Return what a PSNR of pictures means to the eye."""
    for least, words in _WORDS:
        if decibels >= least:
            return words
    return "visible loss"


def _log_loss(run: RenderableScene, gaussians: GaussianArrays, kind: str, display_time: float, note: str) -> None:
    """Measure and log how well Gaussians in the scene's coordinates show it; `note` follows the number of views."""
    views = every_nth(split_or_all(run, "test"), _MAX_COMPARED)
    where = f"{len(views)} view{'s' * (len(views) != 1)}{note}"
    if not views:
        log.info("not compared with the scene, because the file has no cameras")
    elif kind == "ldr":
        decibels = psnr_of(_splat_renderer(gaussians, run, display_time), _photo_renderer(run, display_time), views)
        words = loss_in_words(decibels)
        text = "kept: %.1f dB against the scene's own pictures in %s (%s); lost: light above white"
        log.info(text, decibels, where, words)
    else:
        times = display_time, display_time / 2**_DARKER
        bright, dim = (psnr_of(_splat_renderer(gaussians, run, t), _srgb_renderer(run, t), views) for t in times)
        words = loss_in_words(min(bright, dim))
        text = "kept: %.1f dB against the scene at 0 EV, %.1f dB at -%d EV, in %s (%s)"
        log.info(text, bright, dim, _DARKER, where, words)


def _log_file_loss(
    path: Path, run: RenderableScene, part: GaussianArrays | None, to_file: WorldTransform, display_time: float
) -> None:
    """Measure and log what a compressed file loses, read back, beside the part that was exported or the scene."""
    views = every_nth(split_or_all(run, "test"), _MAX_COMPARED)
    if not views:
        return
    # SPZ does not state the exposure time.
    gaussians = replace(read_gaussians(path).transformed(to_file.inverse().matrix), base_time=display_time)
    if part is None:
        reference, name = _photo_renderer(run, display_time), "the scene"
    else:
        reference, name = _splat_renderer(part, run, display_time), "what was exported"
    decibels = psnr_of(_splat_renderer(gaussians, run, display_time), reference, views)
    files = path.parent.rglob("*") if path.name == STREAMED_SOG else [path]
    size = sum(file.stat().st_size for file in files if file.is_file()) / 1e6
    log.info("compressed: %.1f dB compared with %s (%s), %.2f MB", decibels, name, loss_in_words(decibels), size)


def _photo_renderer(run: RenderableScene, time: float) -> Callable:
    """Return a function that renders simulated photos; in Rec.709 and sRGB if the photos have a sensor's colors."""
    return _srgb_renderer(run, time) if run.color_matrix is not None else lambda camera: run.render_ldr(camera, time)


def _srgb_renderer(run: RenderableScene, time: float) -> Callable:
    """Return a function that renders radiance at an exposure time, encoded by sRGB."""
    encode = response_by_name("srgb").encode
    return lambda camera: encode(run.render(camera).hdr * time)


def _splat_renderer(gaussians: GaussianArrays, run: RenderableScene, time: float) -> Callable:
    """Return a function that renders Gaussians in the scene's coordinates as sRGB, on the run's device."""
    field = on_device(field_of(gaussians), run.device)
    return lambda camera: field.render_ldr(camera, time)


def _write_cameras(path: Path, run: RenderableScene, transform: WorldTransform, overwrite: bool) -> None:
    described, wide = [], [entry.name for entry in run.cameras if not entry.camera.is_pinhole]
    if wide:
        log.info("%s: without %s, because it holds pinholes alone", path.name, first_names(wide, 5))
    for index, entry in enumerate(run.cameras):
        if not entry.camera.is_pinhole:
            continue
        camera = transform.camera(entry.camera)
        pose = camera.camera_to_world
        size = {"width": camera.width, "height": camera.height}
        place = {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}
        lens = {"fy": camera.fy, "fx": camera.fx}
        if (camera.cx, camera.cy) != (camera.width / 2, camera.height / 2):  # An addition to the reference release's
            lens |= {"cx": camera.cx, "cy": camera.cy}
        described.append({"id": index, "img_name": entry.name, **size, **place, **lens})
    with atomic_path(path, overwrite) as temporary:
        temporary.write_text(json.dumps(described), encoding="utf-8")
