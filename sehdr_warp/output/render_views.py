"""Pictures of a trained scene: HDR files, previews and exposure brackets, for any set of cameras."""

import logging
from collections import deque
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from sehdr_warp.errors import SehdrError
from sehdr_warp.scene import Camera, load_cameras
from sehdr_warp.scene.images import MAX_PIXELS

from ..files import atomic_folder, atomic_path
from ..model.exposure import Items
from .brackets import Brackets, bracket_exposures
from .camera_paths import evenly, interpolate, orbit
from .colorspace import from_rec709
from .exr import Part, rgb_channels, write_multipart_exr
from .images import as_array, quantize, write_picture
from .light_pictures import exposure_of_white
from .names import safe_names
from .ocio import ocio_view
from .passes import data_parts, read_passes
from .tonemap import ToneMap, fit_tone_map
from .usd_cameras import usd_cameras

log = logging.getLogger(__name__)
SPLITS = ("train", "test", "all")
PATHS = ("orbit", "interpolate")

_FIT_VIEWS, _FIT_SIZE = 4, 160  # Of the pictures that a tone map is fitted to
_SEEN = 0.01  # Mean coverage below which a picture shows nothing: stray Gaussians are nearly everywhere


def render_views(
    run: Any,
    out: Path | str,
    *,
    cameras: str | Path = "test",
    count: int = 60,
    evs: Items | None = None,
    exposures: Items | None = None,
    multipart: bool = False,
    by: str = "view",
    colorspace: str = "rec709",
    white: float | None = None,
    pixel: str = "half",
    overwrite: bool = False,
    ldr_brackets: str | None = None,
    passes: str | Sequence[str] = (),
    size: str | tuple[int, int] | None = None,
    ocio: str | None = None,
    view: str | None = None,
) -> list[Path]:
    """Renders views of a run; returns the files written. Everything appears when the last view is done.

    Always: `hdr/<view>.exr` (R, G, B scene-linear radiance; A coverage; Z distance along the axis, 0 where empty;
    confidence, if the run has it), `preview/<view>.png` (tone-mapped, sRGB) and `cameras.usda`. Cameras that see
    nothing are named in a warning.

    Args:
        run: of load_run, train or load_splats.
        out: the folder for the files.
        cameras: "train", "test", "all", "orbit", "interpolate", or a file (see load_cameras).
        count: views of an orbit or interpolation.
        evs: brackets, as write_brackets makes them, through the run's response.
        exposures: likewise.
        multipart: as of write_brackets.
        by: as of write_brackets.
        colorspace: primaries of the EXR files.
        white: what `hdr/` shows the photos' white as, by an exposure that its `expTime` states; None leaves radiance.
        pixel: "half" or "float".
        overwrite: replaces the folders hdr, preview and brackets of an earlier render; other files in `out` stay.
        ldr_brackets: as ldr of write_brackets.
        passes: of depth, position, normals, alpha, confidence and clipped, each a part of its own of `hdr/<view>.exr`.
        size: width and height in pixels, or "1920x1080", in place of the cameras' own: the vertical field of view
            stays.
        ocio: a config of OpenColorIO for the previews (see ocio_view).
        view: a view in it.

    Raises:
        SehdrError: for unusable options or an empty set of cameras.
        InputError: where something would be replaced or a pixel is not finite.
    """
    out = Path(out)
    wanted = evs is not None or exposures is not None
    if (multipart or ldr_brackets or by != "view") and not wanted:
        raise SehdrError("brackets were asked for without exposures; give evs (--evs=-2,0,2) or exposures")
    made = bracket_exposures(run.base_time, evs=evs, exposures=exposures) if wanted else ()
    form, now = (colorspace, pixel, multipart, ldr_brackets, run.response), datetime.now().replace(microsecond=0)
    brackets = Brackets(made, run.base_time, *form, now, provenance(run), by)
    exposure = exposure_of_white(run, white)
    if (ocio is None) != (view is None):
        raise SehdrError("previews through OpenColorIO need ocio, a config, and view, one of its views")
    look = None if ocio is None or view is None else ocio_view(ocio, view, exposure_of_white(run, 1.0))
    passes = read_passes(passes) if passes else ()
    views = select_cameras(run, cameras, count=count)
    if size is not None:
        width, height = read_size(size)
        views = [(name, framed(camera, width, height)) for name, camera in views]
    empty = []

    def write_pictures(hdr_folder: Path, preview_folder: Path) -> Iterator[tuple[str, np.ndarray, Camera]]:
        """Writes each view, and yields what its brackets are made of."""
        tone_map = look or shared_tone_map(run, [camera for _, camera in views])
        for index, (name, camera) in enumerate(views, start=1):
            rendered, confidence = run.render(camera), run.render_confidence(camera)
            hdr = as_array(rendered.hdr)
            channels = rgb_channels(from_rec709(hdr, colorspace) * exposure)
            channels |= {"A": as_array(rendered.alpha), "Z": as_array(rendered.depth)}
            if confidence is not None:
                channels["confidence"] = as_array(confidence)
            elif index == 1:
                log.info("without a confidence channel: `sehdr-warp report` measures it, from the photos")
            header = brackets.header(name, exposure, camera)
            parts = [Part(channels, header, "rgba" if passes else "")]
            parts += data_parts(passes, run, rendered, camera, header)
            stored = write_multipart_exr(hdr_folder / f"{name}.exr", parts, pixel=pixel)
            if channels["A"].mean() < _SEEN:
                empty.append(name)
            write_picture(preview_folder / f"{name}.png", quantize(tone_map(hdr)))
            log.info("%s (%d of %d)", name, index, len(views))
            if stored != pixel:
                log.info("%s: holds values above 65504, which half cannot; written as float", name)
            yield name, hdr, camera

    files = [out / place.format(name) for place in ("hdr/{}.exr", "preview/{}.png") for name, _ in views]
    with (
        atomic_path(out / "cameras.usda", overwrite) as stage,
        atomic_folder(out / "hdr", overwrite) as hdr,
        atomic_folder(out / "preview", overwrite) as preview,
    ):
        stage.write_text(usd_cameras(views), encoding="utf-8")
        pictures = write_pictures(hdr, preview)
        if wanted:
            files += [*brackets.write(out, pictures, overwrite), out / "brackets.json"]
        deque(pictures, maxlen=0)
    if empty:
        listed = ", ".join(empty[:5]) + (", ..." if len(empty) > 5 else "")
        problem = "see nothing of the scene, or next to nothing: are they in its coordinates, and do they look at it?"
        log.warning("%d of %d cameras (%s) %s", len(empty), len(views), listed, problem)
    return [*files, out / "cameras.usda"]


def shared_tone_map(run: Any, cameras: Sequence[Camera]) -> ToneMap:
    """One for all pictures of these cameras, fitted to a few small ones."""
    return fit_tone_map([as_array(run.render(camera.within(_FIT_SIZE)).hdr) for camera in evenly(cameras, _FIT_VIEWS)])


def read_size(size: str | tuple[int, int]) -> tuple[int, int]:
    """Width and height in pixels, of "1920x1080" or a pair; SehdrError for what is none."""
    try:
        width, height = (int(side) for side in (size.lower().split("x") if isinstance(size, str) else size))
    except (ValueError, TypeError):
        width = height = 0
    if min(width, height) < 1 or width * height > MAX_PIXELS:
        raise SehdrError(f"size {size!r} cannot be; write width and height in pixels, such as 1920x1080")
    return width, height


def framed(camera: Camera, width: int, height: int) -> Camera:
    """A camera of another size with the same vertical field of view and square pixels as before; at the sides more or
    less is seen."""
    scale = height / camera.height
    cx = width / 2 + (camera.cx - camera.width / 2) * scale
    return Camera(width, height, camera.fx * scale, camera.fy * scale, cx, camera.cy * scale, camera.world_to_camera)


def select_cameras(run, cameras: str | Path, *, count: int = 60) -> list[tuple[str, Camera]]:
    """Cameras by names that are safe for files and all different; raises SehdrError where there are none, or for what
    is neither a known name nor a file."""
    text, known = str(cameras), ", ".join(SPLITS + PATHS)
    if text in SPLITS:
        named = [(entry.name, entry.camera) for entry in run.cameras if text in (entry.split, "all")]
        if not named:
            others = known.replace(f"{text}, ", "")
            raise SehdrError(f"the run has no {text} views; choose other cameras ({others}, a file)")
    elif text in PATHS:
        seen = [entry.camera for entry in run.cameras if entry.split == "train"]
        path = interpolate(seen, count) if text == "interpolate" else orbit(seen, count, _focus_distance(run, seen))
        digits = max(3, len(str(count - 1)))
        return [(f"{text}_{index:0{digits}d}", camera) for index, camera in enumerate(path)]
    elif Path(cameras).exists():
        named = load_cameras(Path(cameras))
    else:
        raise SehdrError(f"cameras {text!r} are neither a file nor one of {known}")
    return list(zip(safe_names([name for name, _ in named]), [camera for _, camera in named], strict=True))


def provenance(run) -> dict[str, str]:
    """Where a picture came from, as text by key."""
    known = {"scene": run.scene_name, "iterations": run.iterations, "units": "relative radiance"}
    known["response"] = getattr(run.response, "name", None)
    return {key: str(value) for key, value in known.items() if value not in (None, "")}


def _focus_distance(run, cameras: Sequence[Camera]) -> float:
    """The median depth in a small render of the middle camera; 1 where nothing is seen."""
    if not cameras:
        return 1.0
    depth = as_array(run.render(cameras[len(cameras) // 2].within(_FIT_SIZE)).depth)
    depth = depth[depth > 0]
    return float(np.median(depth)) if depth.size else 1.0
