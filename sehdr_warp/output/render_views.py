"""Pictures of a trained scene: HDR files, previews and exposure brackets, for any set of cameras."""

import logging
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import SehdrError, path_of, require_loaded
from ..files import atomic_folder, atomic_path
from ..model.exposure import Exposures
from ..progress import track_progress
from ..scene import Camera
from ..scene.exposure.times import shutter
from ..subsets import evenly, first_names
from .brackets import BracketWriter, bracket_exposures, remove_earlier
from .cameras.exchange import camera_path, chan_cameras, nerfstudio_path, usd_cameras
from .cameras.selection import check_cameras, may_move, read_size, select_cameras
from .images.display import display_gain, exposure_for_white
from .images.exr import check_pixel_type, write_multipart_exr
from .images.ldr_files import quantize, write_picture
from .images.ocio import ocio_view
from .images.tonemap import ToneMap, fit_tone_map
from .picture_header import PictureHeader
from .view_images import data_parts, read_aovs, render_images
from .world_transform import WorldTransform, photos_to_file, photos_to_scene, world_transform

if TYPE_CHECKING:
    from ..runs.run import RenderableScene

log = logging.getLogger(__name__)

_FIT_VIEWS, _FIT_SIZE = 4, 160  # Number and longest side of the pictures that a tone map is fitted to
_SAME_EXPOSURE = 1.1  # Photos whose exposure times differ by less have one exposure
_LEAST_ALPHA = 0.01  # Mean coverage below which a picture counts as empty: stray Gaussians are nearly everywhere
# Written only on request, or only for a path of cameras: what an earlier render left of them is removed. Every render
# replaces hdr/ and preview/.
_OPTIONAL = ("brackets", "brackets_ldr", "brackets.json", "cameras.usda", "cameras.chan", "camera_path.json")


def render_views(
    run: "RenderableScene",
    out: Path | str,
    *,
    cameras: str | Path = "test",
    camera: str | None = None,
    count: int = 60,
    evs: Exposures | None = None,
    exposures: Exposures | None = None,
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
    empty; confidence, if the run has it), `preview/<view>.png` (tone-mapped, sRGB) and, for pinholes, `cameras.usda`,
    in which a path of two or more cameras is one moving camera. For such a path also `cameras.chan` (Nuke) and
    `camera_path.json` (nerfstudio, in the photos' coordinates). A path is an orbit, an interpolation, or the cameras of
    a file whose names count up (frame_0001, ...); views of the run and of a COLMAP model are separate photos. A warning
    names cameras that show nothing of the scene.

    Args:
        run: From load_run, train or load_splats.
        out: Folder for the files.
        cameras: "train", "test", "all", "orbit", "interpolate", or a file (see load_cameras).
        camera: Only this photo's view of the run, or this camera of a file, by name; a moving one with all its frames.
        count: Views of an orbit or interpolation.
        evs: Brackets in stops from run.base_time, the photos' median exposure, such as "-4,-2,0" or [-4, -2, 0]. Set
            either evs or exposures.
        exposures: Brackets in seconds, stops or multiples of the base exposure, such as "1/125, -2ev, 8x".
        multipart: Write one EXR file with all exposures of a view.
        group_by: "view" or "exposure": what one folder of brackets holds.
        colorspace: Primaries of the EXR files.
        reference_white: Value of the photos' white in `hdr/`; `expTime` states the exposure. None leaves radiance.
        pixel: "half" or "float".
        overwrite: Replace what an earlier render wrote to `out`, and remove its brackets and camera files that this
            one does not write. What was changed since, and other files, stay.
        ldr_brackets: "jpeg", "png" or "png16": also write the brackets as simulated photos, through the response.
        aovs: Any of depth, position, normals, alpha, confidence and clipped, or "all". Each is a part of its own in
            `hdr/<view>.exr`.
        size: Width and height in pixels, or "1920x1080", instead of the cameras' own. The vertical field of view stays.
        ocio: OpenColorIO config for the previews (see ocio_view).
        view: View of that config, or "DISPLAY/VIEW"; required with ocio.
        axes: Coordinates of camera matrices, positions, normals and depths in the files, and of cameras read from
            OpenUSD and .chan files: "upright" (see world_transform) or "scene". Camera files of other kinds are in the
            photos' coordinates.
        up: As in world_transform.
        scale: As in world_transform.
        fps: Frames a second of a path, which its camera files state.

    Raises:
        SehdrError: For unusable options or an empty set of cameras.
        InputError: If a file would be replaced or a pixel is not finite.
    """
    require_loaded("load_run", run)
    options = {"multipart": multipart, "ldr_brackets": ldr_brackets, "group_by": group_by, "ocio": ocio, "view": view}
    check_options(cameras, size, aovs=aovs, evs=evs, exposures=exposures, pixel=pixel, **options)
    out, aov_names = path_of(out, "out"), read_aovs(aovs)
    transform = world_transform(run, axes, up=up, scale=scale)
    views = select_cameras(run, cameras, camera=camera, count=count, size=size, transform=transform, up=up)
    camera_files = _camera_files(run, views, transform, fps, moves=may_move(cameras))
    header = PictureHeader.of(run, transform, colorspace)
    hdr_exposure = exposure_for_white(run, reference_white)
    brackets = None
    if evs is not None or exposures is not None:
        brackets = BracketWriter(
            out=out,
            exposures=bracket_exposures(run.base_time, evs=evs, exposures=exposures),
            header=header,
            pixel=pixel,
            multipart=multipart,
            ldr=ldr_brackets,
            response=run.response,
            group_by=group_by,
        )
        _log_base_exposure(run)
    to_display = None if ocio is None or view is None else ocio_view(ocio, view, exposure_for_white(run, 1.0))
    empty = []
    with ExitStack() as stack:  # What is entered first takes its place last: brackets do so before cameras.
        for name, text in camera_files.items():
            stack.enter_context(atomic_path(out / name, overwrite)).write_text(text, encoding="utf-8")
        hdr_folder = stack.enter_context(atomic_folder(out / "hdr", overwrite))
        preview_folder = stack.enter_context(atomic_folder(out / "preview", overwrite))
        if brackets is not None:
            stack.enter_context(brackets.open(overwrite))
        to_display = to_display or shared_tone_map(run, [each for _, each in views])
        for index, (name, view_camera) in track_progress("rendering views", views, log):
            images = render_images(run, view_camera, transform, aov_names)
            if images.confidence is None and index == 0:
                log.info("without a confidence channel; for a run, `sehdr-warp report` measures it, from the photos")
            channels = {"A": images.alpha, "Z": images.depth}
            if images.confidence is not None:
                channels["confidence"] = images.confidence
            title = "rgba" if aov_names else ""  # A file of one part needs no name
            picture = header.part(images.hdr, hdr_exposure, images.camera, channels, title, view=name)
            parts = [picture, *data_parts(aov_names, images, picture.header)]
            if write_multipart_exr(hdr_folder / f"{name}.exr", parts, pixel=pixel) != pixel:
                log.info("%s: holds values above 65504, which half cannot; written as float", name)
            write_picture(preview_folder / f"{name}.png", quantize(to_display(images.hdr)))
            if brackets is not None:
                brackets.write(name, images.hdr, images.camera)
            if images.alpha.mean() < _LEAST_ALPHA:
                empty.append(name)
    if empty:
        problem = "see nothing of the scene, or next to nothing: are they in its coordinates, and do they look at it?"
        log.warning("%d of %d cameras (%s) %s", len(empty), len(views), first_names(empty, 5), problem)
    files = [out / place.format(name) for place in ("hdr/{}.exr", "preview/{}.png") for name, _ in views]
    if brackets is not None:
        files += [*brackets.files(), out / "brackets.json"]
    files += [out / name for name in camera_files]
    if overwrite:
        written = {file.relative_to(out).parts[0] for file in files}
        remove_earlier(out, [name for name in _OPTIONAL if name not in written])
    return files


def check_options(
    cameras: str | Path,
    size: str | tuple[int, int] | None,
    *,
    aovs: str | Sequence[str],
    evs: Exposures | None,
    exposures: Exposures | None,
    pixel: str,
    multipart: bool,
    ldr_brackets: str | None,
    group_by: str,
    ocio: str | None,
    view: str | None,
) -> None:
    """Raise the errors of render_views() that need no scene, whose loading takes seconds; arguments as there."""
    check_cameras(cameras)
    if size is not None:
        read_size(size)
    read_aovs(aovs)
    for_brackets = {"multipart": multipart, "ldr_brackets": ldr_brackets, "group_by": group_by != "view"}
    if evs is None and exposures is None and (names := [name for name, is_set in for_brackets.items() if is_set]):
        raise SehdrError(f"{', '.join(names)}: brackets need exposures; set evs (--evs=-2,0,2) or exposures")
    check_pixel_type(pixel)
    if (ocio is None) != (view is None):
        need = "previews through OpenColorIO need --ocio, a config, and --view, one of its views"
        raise SehdrError(f"{need}; --camera chooses the view of a photo")


def _camera_files(
    run: "RenderableScene", views: Sequence[tuple[str, Camera]], transform: WorldTransform, fps: float, *, moves: bool
) -> dict[str, str]:
    """Return the names and texts of the files that hold the cameras of a render, as far as they are pinholes.

    moves: Whether the cameras may be frames of one that moves.
    """
    pinholes = [(name, camera) for name, camera in views if camera.is_pinhole]
    if len(pinholes) < len(views):
        wide = first_names([name for name, camera in views if not camera.is_pinhole], 5)
        log.info("cameras.usda: without %s, because OpenUSD has neither panoramas nor fisheye cameras", wide)
    if not pinholes:
        return {}
    cameras = [(name, transform.camera(camera)) for name, camera in pinholes]
    moving = camera_path(cameras) if moves else None
    files = {"cameras.usda": usd_cameras(cameras, photos_to_file(run, transform), path=moving, fps=fps)}
    if moving is not None:
        files["cameras.chan"] = chan_cameras(moving)
        # nerfstudio's dataparser_transforms.json starts from the photos' coordinates.
        to_photos = photos_to_scene(run).inverse()
        files["camera_path.json"] = nerfstudio_path([to_photos.camera(camera) for _, camera in pinholes], fps)
    return files


def _log_base_exposure(run: "RenderableScene") -> None:
    """Log what 0 EV of brackets is if the photos have several exposure times."""
    times = [entry.exposure_time for entry in run.cameras if entry.split == "train"] or [run.base_time]
    if max(times) > _SAME_EXPOSURE * min(times):
        # base_time is the median of corrected times.
        median = "median exposure" + " corrected for drift" * (run.exposure_compensation is not None)
        text = "0 EV of the brackets is %s, the photos' %s; their times are %s to %s"
        log.info(text, shutter(run.base_time), median, shutter(min(times)), shutter(max(times)))


def shared_tone_map(run: "RenderableScene", cameras: Sequence[Camera]) -> ToneMap:
    """Return one tone map for all pictures of some cameras, fitted to a few small renders."""
    small = [camera.within(_FIT_SIZE) for camera in evenly(cameras, _FIT_VIEWS)]
    renders = [run.render(camera, supersample=False) for camera in small]
    pictures, alphas = zip(*((each.hdr.cpu().numpy(), each.alpha.cpu().numpy()) for each in renders), strict=True)
    return fit_tone_map(pictures, alphas, run.base_time * display_gain(run.response))
