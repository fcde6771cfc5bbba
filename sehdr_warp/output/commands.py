"""The command lines of `sehdr-warp render`, `report` and `export`. torch is imported when they run."""

import json
import logging
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from ..arguments import positive
from ..errors import InputError, UsageError
from ..files import check_absent
from ..runs.open import load_run_photos_with_confidence, open_run, open_scene

log = logging.getLogger(__name__)

_NOT_OF_VIEWS = {"run", "device", "json", "video", "fps", "transfer", "ev_ramp"}
_OF_FILMS_TOO = {*_NOT_OF_VIEWS, "cameras", "count", "size", "overwrite", "out"}
_MOST_STOPS = 30


@dataclass(frozen=True, kw_only=True)
class _OfRun:
    run: Positional[Path]
    """Folder of a run, or a file of Gaussians (not for reports)."""
    overwrite: bool = False
    """Replace files that exist."""


@dataclass(frozen=True, kw_only=True)
class _Rendered(_OfRun):
    out: Path
    """Folder for the pictures."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""


@dataclass(frozen=True, kw_only=True)
class Render(_Rendered):
    """Render HDR EXR, previews and exposure brackets of a trained scene, or a film. Needs no photos."""

    out: Path | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Folder for the pictures."""
    cameras: str = "test"
    """test, train, all, orbit, interpolate, or cameras of your own: JSON, OpenUSD, or a COLMAP model's folder."""
    count: int = 60
    """Views of an orbit or interpolation."""
    size: str | None = None
    """Width and height in pixels, such as 1920x1080; by default the cameras' own."""
    passes: str = ""
    """Parts of the EXR files beside the picture, such as depth,normals: depth, position, normals, alpha, confidence,
    clipped."""
    evs: str | None = None
    """Brackets in stops from the photos' exposure, such as --evs=-4,-2,0,2,4."""
    exposures: str | None = None
    """Brackets as seconds (1/125), multiples of the photos' exposure (1/8x) or stops from it (-2ev): 1/125,1/30,1x."""
    multipart: bool = False
    """One multi-part EXR file for all exposures of a view."""
    by: Literal["view", "exposure"] = "view"
    """What a folder of brackets holds: all exposures of a view, or the sequence of all views at an exposure."""
    ldr_brackets: Literal["jpeg", "png", "png16"] | None = None
    """Also write the brackets as simulated photos, through the camera response."""
    colorspace: str = "rec709"
    """Primaries of the EXR files, always scene-linear: rec709, acescg, aces2065-1, rec2020, display-p3 or dci-p3."""
    white: float | None = None
    """Value of the photos' white in hdr/, such as 1; without, the files hold radiance."""
    pixel: Literal["half", "float"] = "half"
    """Pixel type of the EXR files."""
    ocio: str | None = None
    """Config of OpenColorIO for the previews: a file, or ocio://default."""
    view: str | None = None
    """View of that config, or DISPLAY/VIEW."""
    video: Path | None = None
    """A film of the cameras, such as orbit.mp4; without --out no pictures are written."""
    fps: float = 24.0
    """Frames a second of the film."""
    transfer: Literal["sdr", "hlg", "hdr10", "logc3", "slog3", "acescct"] = "sdr"
    """What the film is for: any display (H.264), HDR displays (hlg, hdr10: HEVC, 10 bits), or grading (ProRes 4444 in a
    camera's logarithm, .mov)."""
    ev_ramp: str | None = None
    """Exposure of the film from its first frame to its last, in stops from the photos': --ev-ramp=-4:4."""
    json: bool = False
    """Print the written files as JSON on standard output."""


@dataclass(frozen=True, kw_only=True)
class Report(_Rendered):
    """Write report.html: figures, photo, scene and truth side by side, brackets, where it fails; and pictures."""

    data: str | None = None
    """The photos, if they have moved since the training."""


@dataclass(frozen=True)
class _SplatFile:
    """"""

    kind: Literal["hdr", "ldr"] | None = None
    """ldr: the colors of a photo, as viewers show them. hdr: scene-linear radiance. By default ldr, of USD hdr."""
    exposure: str | None = None
    """Of ldr colors: seconds (1/125), stops from the photos' exposure (-2ev) or multiples of it (1/8x)."""
    degree: int | None = None
    """Pad the harmonics with zeros up to this degree, for readers that take 3 alone."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""


@dataclass(frozen=True, kw_only=True)
class Export(_OfRun):
    """Write the Gaussians as PLY, OpenUSD or glTF, for viewers and other tools, or as a page that shows them in HDR."""

    out: Path
    """The file; its suffix decides: .ply, .glb (glTF), .usda, .usdc or .usdz (OpenUSD), .html (a page to send)."""
    file: _SplatFile = _SplatFile()
    cameras: bool = False
    """Also write cameras.json beside it, as viewers of the reference release read it."""


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Turn a file of Gaussians into one of another kind: PLY, OpenUSD or glTF."""

    source: Positional[Path]
    """The file: .ply, .glb, .usda, .usdc or .usdz."""
    out: Positional[Path]
    """The file to write; its suffix decides."""
    file: _SplatFile = _SplatFile()
    overwrite: bool = False
    """Replace a file that exists."""


@dataclass(frozen=True, kw_only=True)
class Panorama(_OfRun):
    """Write an environment map: the light that reaches a point of the scene from all directions."""

    out: Path
    """The file: .exr, or .hdr without alpha and confidence."""
    at: str = "center"
    """x,y,z in the scene's coordinates, camera:NAME, or center: the middle of the training cameras."""
    size: int = 2048
    """Pixels across; of a cube those of one face."""
    layout: Literal["latlong", "cube"] = "latlong"
    """Latitude and longitude, twice as wide as high; or OpenEXR's six faces, one above the other."""
    axes: Literal["upright", "scene"] = "upright"
    """upright: +Y is up in the photos, and what is ahead stands in the middle. scene: the scene's own coordinates."""
    fill: bool = False
    """Give directions that no photo saw the light around them; alpha tells them still."""
    colorspace: str = "rec709"
    """Primaries, always scene-linear: rec709, acescg, aces2065-1, rec2020, display-p3 or dci-p3."""
    white: float | None = None
    """Value of the photos' white in the file, such as 1, which suits a dome light; without, it holds radiance."""
    pixel: Literal["half", "float"] = "half"
    """Pixel type of an EXR file."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""


def run_panorama(asked: Panorama) -> None:
    from .panorama import write_panorama

    options = {name: value for name, value in vars(asked).items() if name not in ("run", "out", "device")}
    print(write_panorama(open_scene(asked.run, asked.device), asked.out, **options))


def run_render(asked: Render) -> None:
    from .render_views import PATHS, render_views

    if asked.out is None and asked.video is None:
        raise UsageError(
            "render needs --out, a folder for the pictures, or --video, a film; see sehdr-warp render --help"
        )
    if asked.video is None and (asked.ev_ramp is not None or (asked.fps, asked.transfer) != (24.0, "sdr")):
        raise UsageError("--ev-ramp, --fps and --transfer are of a film; name it with --video")
    lost = [field.name for field in fields(asked) if getattr(asked, field.name) != field.default]
    lost = ["--" + name.replace("_", "-") for name in lost if name not in _OF_FILMS_TOO]
    if asked.out is None and lost:
        raise UsageError(f"{', '.join(lost)}: of pictures, and none are written beside a film without --out")
    if asked.count != Render.count and asked.cameras not in PATHS:
        raise UsageError(f"--count {asked.count}: of an orbit or interpolation; name one with --cameras")
    written, ramp, film = [], _ramp(asked.ev_ramp), ""
    if asked.video is not None:
        from .film import film_library

        film_library()
        check_absent(asked.video, asked.overwrite)
    run = open_scene(asked.run, asked.device)
    if asked.out is not None:
        written = render_views(run, **{name: value for name, value in vars(asked).items() if name not in _NOT_OF_VIEWS})
    if asked.video is not None:
        from .film import write_film
        from .render_views import framed, read_size, select_cameras

        cameras = [camera for _, camera in select_cameras(run, asked.cameras, count=asked.count)]
        if asked.size is not None:
            cameras = [framed(camera, *read_size(asked.size)) for camera in cameras]
        options = {"fps": positive("--fps", asked.fps), "transfer": asked.transfer, "ev_ramp": ramp}
        written.append(write_film(run, asked.video, cameras, **options, overwrite=asked.overwrite))
        if len(cameras) == 1:
            log.warning("%s: '%s' is one camera, so one frame; --cameras orbit is a path", asked.video, asked.cameras)
        film = f"{asked.video}: {len(cameras)} frame{'s' * (len(cameras) > 1)}, {len(cameras) / asked.fps:.3g} s"
    if asked.json:
        print(json.dumps({"files": [str(path) for path in written]}))
    elif asked.out is None:
        print(film)
    else:
        print(f"{asked.out}: {len(written)} files")


def _ramp(text: str | None) -> tuple[float, float]:
    """The stops of --ev-ramp, a number or two with a colon between."""
    if text is None:
        return 0.0, 0.0
    with suppress(ValueError):
        stops = [float(part) for part in text.split(":")]
        if len(stops) in (1, 2) and all(abs(stop) <= _MOST_STOPS for stop in stops):
            return stops[0], stops[-1]
    problem = f"is not stops from -{_MOST_STOPS} to {_MOST_STOPS}, with a colon between"
    raise InputError(f"--ev-ramp {text}", problem, "write for example --ev-ramp=-4:4")


def run_report(asked: Report) -> None:
    from ..evaluation.evaluate import evaluate
    from .report import write_report

    check_absent(asked.out / "report.html", asked.overwrite)
    run = open_run(asked.run, asked.device)
    scene = load_run_photos_with_confidence(run, asked.data)
    for path in write_report(run, scene, asked.out, overwrite=asked.overwrite, evaluation=evaluate(run, scene)):
        print(path)


def run_export(asked: Export) -> None:
    from ..splats import check_suffix

    if check_suffix(asked.out, ".html") == ".html":
        from .scene_page import write_scene_page

        if asked.cameras or (asked.file.kind, asked.file.exposure, asked.file.degree) != (None, None, None):
            raise UsageError("a page has its exposure, cameras and harmonics; --out alone goes with .html")
        print(write_scene_page(open_scene(asked.run, asked.file.device), asked.out, overwrite=asked.overwrite))
        return
    _export(asked.run, asked.out, asked.file, cameras=asked.cameras, overwrite=asked.overwrite)


def run_convert(asked: Convert) -> None:
    from ..splats import check_suffix

    check_suffix(asked.source)
    _export(asked.source, asked.out, asked.file, overwrite=asked.overwrite)


def _export(source: Path, out: Path, asked: _SplatFile, **options) -> None:
    from ..model.exposure import exposure_times
    from ..splats import check_suffix
    from .export import export

    check_suffix(out)  # Before the scene is opened.
    run = open_scene(source, asked.device)
    time = None if asked.exposure is None else exposure_times(run.base_time, asked.exposure)[0]
    print(export(run, out, kind=asked.kind, exposure_time=time, degree=asked.degree, **options))
