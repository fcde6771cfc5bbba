"""Pictures of a trained scene: HDR files, previews and exposure brackets, for any set of cameras."""

import logging
import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import InputError, SehdrError, did_you_mean
from ..files import atomic_folder, atomic_path
from ..model.exposure import Items
from ..progress import track_progress
from ..scene import Camera, load_cameras
from ..scene.exchange_cameras import EXCHANGE_SUFFIXES, read_exchange_cameras
from ..scene.images import MAX_PIXELS
from ..subsets import first_names
from .aovs import ViewData, data_parts, read_aovs
from .brackets import Brackets, PictureHeader, bracket_exposures
from .camera_exchange import camera_path, chan_cameras, nerfstudio_path, usd_cameras
from .camera_paths import evenly, interpolate, training_cameras
from .colorspace import from_rec709
from .exr import Part, rgb_channels, stored_pixel_type, write_multipart_exr
from .framing import default_path, film_camera
from .images import as_array, quantize, safe_names, write_picture
from .light_unit import luminance_of_one, read_light_unit
from .ocio import ocio_view
from .tonemap import ToneMap, exposure_of_white, fit_tone_map
from .world_transform import WorldTransform, describe, world_transform

if TYPE_CHECKING:
    from ..runs.run import RenderableScene

log = logging.getLogger(__name__)
SPLITS = ("train", "test", "all")
PATHS = ("orbit", "interpolate")

_FIT_VIEWS, _FIT_SIZE = 4, 160  # Number and longest side of the pictures that a tone map is fitted to
_LEAST_ALPHA = 0.01  # Mean coverage below which a picture counts as empty: stray Gaussians are nearly everywhere


def render_views(
    run: "RenderableScene",
    out: Path | str,
    *,
    cameras: str | Path = "test",
    camera: str | None = None,
    count: int = 60,
    evs: Items | None = None,
    exposures: Items | None = None,
    multipart: bool = False,
    group_by: str = "view",
    colorspace: str = "rec709",
    reference_white: float | None = None,
    pixel: str = "half",
    overwrite: bool = False,
    ldr_brackets: str | None = None,
    aovs: str | Sequence[str] = (),
    size: str | tuple[int, int] | None = None,
    ocio: str | None = None,
    view: str | None = None,
    axes: str = "upright",
    up: str | Sequence[float] | None = None,
    scale: float | None = None,
    fps: float = 24.0,
) -> list[Path]:
    """Render views of a run into files and return their paths. All files appear when the last view is complete.

    Always written: `hdr/<view>.exr` (R, G, B scene-linear radiance; A coverage; Z distance along the axis, 0 where
    empty; confidence, if the run has it), `preview/<view>.png` (tone-mapped, sRGB) and `cameras.usda`, in which a path
    of cameras is one moving camera. For a path also `cameras.chan` (Nuke) and `camera_path.json` (nerfstudio, in the
    set's own coordinates). A warning names cameras that show nothing of the scene.

    Args:
        run: From load_run, train or load_splats.
        out: Folder for the files.
        cameras: "train", "test", "all", "orbit", "interpolate", or a file (see load_cameras).
        camera: Only this camera of a file, by its name there; a moving one with all its frames.
        count: Views of an orbit or interpolation.
        evs: Brackets, as in write_brackets, through the run's response.
        exposures: Brackets, as in write_brackets.
        multipart: As in write_brackets.
        group_by: As in write_brackets.
        colorspace: Primaries of the EXR files.
        reference_white: Value of the photos' white in `hdr/`; `expTime` states the exposure. None leaves radiance.
        pixel: "half" or "float".
        overwrite: Replace the folders hdr, preview and brackets of an earlier render. Other files in `out` stay.
        ldr_brackets: As ldr in write_brackets.
        aovs: Any of depth, position, normals, alpha, confidence and clipped, or "all". Each is a part of its own in
            `hdr/<view>.exr`.
        size: Width and height in pixels, or "1920x1080", instead of the cameras' own. The vertical field of view stays.
        ocio: OpenColorIO config for the previews (see ocio_view).
        view: View of that config, or "DISPLAY/VIEW"; required with ocio.
        axes: Coordinates of camera matrices, positions, normals and depths in the files, and of cameras read from
            OpenUSD and .chan files: "upright" (see world_transform) or "scene". Camera files of other kinds are in the
            scene's own coordinates.
        up: As in world_transform.
        scale: As in world_transform.
        fps: Frames a second of a path, which its camera files state.

    Raises:
        SehdrError: For unusable options or an empty set of cameras.
        InputError: If a file would be replaced or a pixel is not finite.
    """
    out = Path(out)
    header = PictureHeader(
        run.base_time, colorspace, datetime.now().replace(microsecond=0), provenance(run), luminance_of_one(run)
    )
    brackets = None
    if evs is not None or exposures is not None:
        brackets = Brackets(
            exposures=bracket_exposures(run.base_time, evs=evs, exposures=exposures),
            header=header,
            pixel=pixel,
            multipart=multipart,
            ldr=ldr_brackets,
            response=run.response,
            group_by=group_by,
        )
    elif multipart or ldr_brackets or group_by != "view":
        raise SehdrError("brackets need exposures; set evs (--evs=-2,0,2) or exposures")
    stored_pixel_type((), pixel)
    exposure = exposure_of_white(run, reference_white)
    if (ocio is None) != (view is None):
        raise SehdrError("previews through OpenColorIO need ocio, a config, and view, one of its views")
    display_transform = None if ocio is None or view is None else ocio_view(ocio, view, exposure_of_white(run, 1.0))
    aovs = read_aovs(aovs) if aovs else ()
    transform = world_transform(run, axes, up=up, scale=scale)
    views = select_cameras(run, cameras, camera=camera, count=count, transform=transform, up=up)
    if size is not None:
        width, height = read_size(size)
        views = [(name, reframe(camera, width, height)) for name, camera in views]
    are_photos = str(cameras) in SPLITS or (str(cameras) not in PATHS and Path(cameras).is_dir())
    camera_files = _camera_files(views, transform, fps, moving=not are_photos)
    empty = []
    with ExitStack() as stack:
        for name, text in camera_files.items():
            stack.enter_context(atomic_path(out / name, overwrite)).write_text(text, encoding="utf-8")
        hdr_folder = stack.enter_context(atomic_folder(out / "hdr", overwrite))
        preview_folder = stack.enter_context(atomic_folder(out / "preview", overwrite))
        bracket_writer = stack.enter_context(brackets.open(out, overwrite)) if brackets else None
        tone_map = display_transform or shared_tone_map(run, [camera for _, camera in views])
        hdr_writer = _HdrWriter(run, hdr_folder, header, exposure, transform, pixel, aovs)
        for index, (name, view_camera) in track_progress("rendering views", views, log):
            rendered = _render(run, view_camera)
            if rendered.confidence is None and index == 0:
                log.info("without a confidence channel: `sehdr-warp report` measures it, from the photos")
            hdr_writer.write(name, view_camera, rendered)
            write_picture(preview_folder / f"{name}.png", quantize(tone_map(rendered.hdr)))
            if bracket_writer is not None:
                bracket_writer.write(name, rendered.hdr, transform.camera(view_camera))
            if rendered.alpha.mean() < _LEAST_ALPHA:
                empty.append(name)
    if empty:
        names = first_names(empty, 5)
        problem = "see nothing of the scene, or next to nothing: are they in its coordinates, and do they look at it?"
        log.warning("%d of %d cameras (%s) %s", len(empty), len(views), names, problem)
    files = [out / place.format(name) for place in ("hdr/{}.exr", "preview/{}.png") for name, _ in views]
    if bracket_writer is not None:
        files += [*bracket_writer.files(), out / "brackets.json"]
    return [*files, *(out / name for name in camera_files)]


class _ViewImages(NamedTuple):
    """A rendered view; [H, W, 3] linear Rec.709 radiance, and [H, W] of the others, as in RenderedView."""

    hdr: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    confidence: np.ndarray | None


def _render(run: "RenderableScene", camera: Camera) -> _ViewImages:
    """Render a view and copy it to the CPU."""
    view, confidence = run.render(camera), run.render_confidence(camera)
    confidence = None if confidence is None else as_array(confidence)
    return _ViewImages(as_array(view.hdr), as_array(view.alpha), as_array(view.depth), confidence)


@dataclass(frozen=True)
class _HdrWriter:
    """Writes the EXR files of `hdr/`.

    Attributes:
        run: Scene to render AOVs of.
        folder: Folder for the files.
        header: EXR attributes of all views.
        exposure: Factor from radiance to the file's values.
        transform: To the coordinates of files.
        pixel: "half" (float if half would overflow) or "float".
        aovs: Names of AOVS.
    """

    run: "RenderableScene"
    folder: Path
    header: PictureHeader
    exposure: float
    transform: WorldTransform
    pixel: str
    aovs: Sequence[str]

    def write(self, name: str, camera: Camera, rendered: _ViewImages) -> None:
        """Write a view, whose camera is in the scene's own coordinates."""
        camera_in_file = self.transform.camera(camera)
        depth = rendered.depth * np.float32(self.transform.scale)
        attributes = self.header.of(name, self.exposure, camera_in_file, worldMatrix=describe(self.transform))
        channels = rgb_channels(from_rec709(rendered.hdr, self.header.colorspace) * self.exposure)
        channels |= {"A": rendered.alpha, "Z": depth}
        if rendered.confidence is not None:
            channels["confidence"] = rendered.confidence
        parts = [Part(channels, attributes, "rgba" if self.aovs else "")]
        parts += data_parts(self.aovs, ViewData(self.run, camera, camera_in_file, rendered.alpha, depth), attributes)
        if write_multipart_exr(self.folder / f"{name}.exr", parts, pixel=self.pixel) != self.pixel:
            log.info("%s: holds values above 65504, which half cannot; written as float", name)


def _camera_files(
    views: Sequence[tuple[str, Camera]], transform: WorldTransform, fps: float, *, moving: bool
) -> dict[str, str]:
    """Return the names and texts of the files that hold the cameras of a render.

    Args:
        views: Names and cameras in the scene's own coordinates.
        transform: To the coordinates of files.
        fps: Frames a second of a camera that moves.
        moving: Whether the cameras may be frames of one that moves; photos are not, whatever their names.
    """
    cameras = [(name, transform.camera(camera)) for name, camera in views]
    path = camera_path(cameras) if moving else None
    files = {"cameras.usda": usd_cameras(cameras, transform, path=path, fps=fps)}
    if path is not None:
        files["cameras.chan"] = chan_cameras(path)
        # In the set's own coordinates, which nerfstudio's dataparser_transforms.json starts from.
        files["camera_path.json"] = nerfstudio_path(path._replace(cameras=[camera for _, camera in views]), fps)
    return files


def shared_tone_map(run: "RenderableScene", cameras: Sequence[Camera]) -> ToneMap:
    """Return one tone map for all pictures of some cameras, fitted to a few small renders."""
    return fit_tone_map([as_array(run.render(camera.within(_FIT_SIZE)).hdr) for camera in evenly(cameras, _FIT_VIEWS)])


def read_size(size: str | tuple[int, int]) -> tuple[int, int]:
    """Return width and height in pixels from "1920x1080" or a pair; raise SehdrError for anything else."""
    try:
        width, height = (int(side) for side in (size.lower().split("x") if isinstance(size, str) else size))
    except (ValueError, TypeError):
        width = height = 0
    if min(width, height) < 1 or width * height > MAX_PIXELS:
        raise SehdrError(f"size {size!r} is not usable; write width and height in pixels, such as 1920x1080")
    return width, height


def reframe(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera of another size with the same vertical field of view and pixel aspect ratio.

    The picture shows more or less at the sides.
    """
    scale = height / camera.height
    cx = width / 2 + (camera.cx - camera.width / 2) * scale
    intrinsics = {"fx": camera.fx * scale, "fy": camera.fy * scale, "cx": cx, "cy": camera.cy * scale}
    return replace(camera, width=width, height=height, **intrinsics)


def check_cameras(cameras: str | Path) -> None:
    """Raise SehdrError if a choice of cameras is neither a known word nor a file."""
    words = (*SPLITS, *PATHS)
    if str(cameras) not in words and not Path(cameras).exists():
        hint = did_you_mean(str(cameras), words)
        raise SehdrError(f"cameras {str(cameras)!r} are neither a file nor one of {', '.join(words)}{hint}")


def select_cameras(
    run: "RenderableScene",
    cameras: str | Path,
    *,
    camera: str | None = None,
    count: int = 60,
    transform: WorldTransform | None = None,
    up: str | Sequence[float] | None = None,
) -> list[tuple[str, Camera]]:
    """Return named cameras in the scene's own coordinates; the names are safe for files and all different.

    Args:
        run: From load_run, train or load_splats.
        cameras: "train", "test", "all", "orbit", "interpolate", or a file (see load_cameras).
        camera: Only this camera of a file.
        count: Views of an orbit or interpolation.
        transform: From the scene's coordinates to those of camera files that other programs write (OpenUSD, .chan); by
            default that to upright coordinates.
        up: As in world_transform, for an orbit.

    Raises:
        SehdrError: If there are none, or `cameras` is neither a known name nor a file.
    """
    check_cameras(cameras)
    text, choices = str(cameras), ", ".join(SPLITS + PATHS)
    if camera is not None and text in SPLITS + PATHS:
        raise SehdrError(f"--camera {camera}: chooses from a file of cameras, which --cameras {text} is not")
    if text in SPLITS:
        views = [(entry.name, entry.camera) for entry in run.cameras if text in (entry.split, "all")]
        if not views:
            others = choices.replace(f"{text}, ", "")
            raise SehdrError(f"the run has no {text} views; choose other cameras ({others}, a file)")
    elif text in PATHS:
        if text == "orbit":
            path = default_path(run, count, up)
        else:
            photos = training_cameras(run)
            path = [film_camera(each, photos) for each in interpolate(photos, count)]
        digits = max(3, len(str(count - 1)))
        return [(f"{text}_{index:0{digits}d}", camera) for index, camera in enumerate(path)]
    else:
        views = _from_file(run, Path(cameras), transform)
        if camera is not None:
            names = [name for name, _ in views]
            # Frames of a moving camera are named as by read_exchange_cameras(): numbers of four characters or more.
            frames = re.compile(re.escape(camera) + r"_[-\d.]{4,}")
            views = [view for view in views if view[0] == camera] or [
                view for view in views if frames.fullmatch(view[0])
            ]
            if not views:
                raise SehdrError(f"{cameras}: has no camera {camera!r}{did_you_mean(camera, names)}")
    return list(zip(safe_names([name for name, _ in views]), [camera for _, camera in views], strict=True))


def _from_file(run: "RenderableScene", path: Path, transform: WorldTransform | None) -> list[tuple[str, Camera]]:
    """Return the cameras of a file in the scene's own coordinates."""
    views = load_cameras(path)
    if path.suffix.lower() not in EXCHANGE_SUFFIXES:
        return views
    matrix = read_exchange_cameras(path).world_matrix
    try:
        to_file = None if matrix is None else WorldTransform.from_matrix(matrix)
    except ValueError as error:
        raise InputError(path, f"its sehdr:worldMatrix {error}", "leave that entry out of the file") from None
    back = (to_file or transform or world_transform(run)).inverse()
    return [(name, back.camera(camera)) for name, camera in views]


def provenance(run: "RenderableScene") -> dict[str, str]:
    """Return where a picture came from, as text by key."""
    unit = read_light_unit(run)
    values = {"scene": run.scene_name, "iterations": run.iterations, "units": str(unit or "relative radiance")}
    values["response"] = getattr(run.response, "name", None)
    return {key: str(value) for key, value in values.items() if value not in (None, "")}
