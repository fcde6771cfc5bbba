"""Command lines of `sehdr-warp render`, `report`, `envmap`, `lights` and `meter`. torch is imported when they run.

Names of options are those of the arguments of render_views(), write_film(), write_environment_map() and write_lights().
"""

import json
import logging
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Literal

from tyro.conf import Positional

from ..arguments import parse_numbers
from ..errors import InputError, UsageError
from ..files import check_absent
from ..runs.open import load_run_scene_with_confidence, open_run, open_scene

log = logging.getLogger(__name__)

_PICTURE_VIEWS, _FILM_VIEWS = 60, 144  # Of a path without --count
_MOST_STOPS = 30


@dataclass(frozen=True)
class WorldOptions:
    """Coordinates of the files."""

    axes: Literal["upright", "scene"] = "upright"
    """upright: +Y is up (in PLY -Y, as its viewers expect), the subject is in the middle. scene: the photos'
    coordinates."""
    up: str | None = None
    """Up direction in the photos' coordinates, if the photos do not show it: x,y,z, or an axis such as -y."""
    scale: float | None = None
    """Meters for each unit of the scene; by default that set in the viewer, else by GPS, else 1; of axes scene 1."""


@dataclass(frozen=True)
class ViewFileOptions:
    """Options of the pictures that render writes with --out."""

    aovs: str = ""
    """Further parts of the EXR files, such as depth,normals: depth, position, normals, alpha, confidence, clipped, or
    all; the last three need a run with confidence."""
    evs: str | None = None
    """Brackets in stops from the photos' exposure, the median if they differ, such as --evs=-4,-2,0,2,4."""
    exposures: str | None = None
    """Brackets as seconds (1/125), multiples of the photos' exposure (1/8x) or stops from it (-2ev): 1/125,1/30,1x."""
    multipart: bool = False  # One multi-part EXR file for all exposures of a view.
    group_by: Literal["view", "exposure"] = "view"
    """Contents of a folder of brackets: all exposures of a view, or the sequence of all views at an exposure."""
    ldr_brackets: Literal["jpeg", "png", "png16"] | None = None
    """Also write the brackets as simulated photos, through the camera response."""
    colorspace: str = "rec709"
    """Primaries of the EXR files, always scene-linear: rec709, acescg, aces2065-1, rec2020, display-p3 or dci-p3."""
    reference_white: float | None = None
    """Value of display white in hdr/, such as 1, by the photos' middle grey; without it files hold radiance."""
    pixel: Literal["half", "float"] = "half"  # Pixel type of the EXR files.
    ocio: str | None = None  # OpenColorIO config for the previews: a file, or ocio://default.
    view: str | None = None  # View of that config, or DISPLAY/VIEW.


@dataclass(frozen=True)
class FilmOptions:
    """Options of the film that render writes with --video."""

    fps: float = 24.0  # Frames a second, also of the camera files of a path.
    transfer: Literal["sdr", "hlg", "hdr10", "logc3", "slog3", "acescct"] = "sdr"
    """Purpose of the film: any display (H.264), HDR displays (hlg, hdr10: HEVC, 10 bits), or grading (ProRes 4444 in a
    camera's logarithm, .mov)."""
    ev_ramp: str | None = None  # Exposure from the first frame to the last, in stops from the photos': --ev-ramp=-4:4.


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render HDR EXR, previews and exposure brackets of a trained scene, or a film. Needs no photos."""

    removed_flags: ClassVar = {
        "--passes": "the option is --aovs",
        "--by": "the option is --group-by",
        "--white": "the option is --reference-white",
    }

    run: Positional[Path]  # Folder of a run, or a file of Gaussians.
    out: Path | None = None  # Folder for the pictures.
    video: Path | None = None  # A film of the cameras, such as orbit.mp4; without --out no pictures are written.
    cameras: str = "test"
    """test, train, all, orbit, interpolate, or your cameras: OpenUSD, .chan, JSON, or a COLMAP model's folder."""
    camera: str | None = None  # Only the view of this photo, or this camera of a file of several, by name.
    count: int | None = None
    """Views of an orbit or interpolation; by default 60, or 144 for a film alone, which are six seconds."""
    size: str | None = None
    """Width and height in pixels, such as 1920x1080; by default the cameras' own, of orbit and interpolate 16:9."""
    overwrite: bool = False  # Replace files that exist.
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.
    json: bool = False  # Print the written files as JSON on standard output.
    world: WorldOptions = WorldOptions()
    pictures: ViewFileOptions = ViewFileOptions()
    film: FilmOptions = FilmOptions()


def run_render(args: Render) -> None:
    """Run `sehdr-warp render`."""
    _check_render(args)
    ramp = _ramp(args.film.ev_ramp)
    from .cameras.selection import select_cameras
    from .film import write_film
    from .render_views import render_views
    from .world_transform import world_transform

    run = open_scene(args.run, args.device)
    default_count = _FILM_VIEWS if args.out is None else _PICTURE_VIEWS
    count = default_count if args.count is None else args.count
    selection = {"cameras": args.cameras, "camera": args.camera, "count": count, "size": args.size}
    files, fps, summary = [], args.film.fps, ""
    if args.out is not None:
        # The fields of these groups of options are arguments of render_views().
        options = vars(args.world) | vars(args.pictures)
        files = render_views(run, args.out, overwrite=args.overwrite, fps=fps, **selection, **options)
        summary = f"{args.out}: {len(files)} files"
    if args.video is not None:
        transform = world_transform(run, **vars(args.world))
        cameras = [camera for _, camera in select_cameras(run, **selection, transform=transform, up=args.world.up)]
        film = {"fps": fps, "transfer": args.film.transfer, "ev_ramp": ramp}
        files.append(write_film(run, args.video, cameras, **film, overwrite=args.overwrite))
        if len(cameras) == 1 and args.count is None:
            selector = args.camera or args.cameras
            log.warning("%s: '%s' is one camera, so one frame; --cameras orbit is a path", args.video, selector)
        seconds = len(cameras) / fps
        summary = summary or f"{args.video}: {len(cameras)} frame{'s' * (len(cameras) > 1)}, {seconds:.3g} s"
    print(json.dumps({"files": [str(path) for path in files]}) if args.json else summary)


def _check_render(args: Render) -> None:
    """Check the options before a scene is loaded, which takes seconds.

    Raises UsageError or SehdrError for options that do not fit each other or are out of range.
    """
    from .images.colorspace import color_space

    color_space(args.pictures.colorspace)  # Before modules that take long to load
    from .cameras.selection import PATHS, may_move
    from .film import check_rate, film_format, film_library
    from .render_views import check_options

    if args.out is None and args.video is None:
        problem = "render needs --out, a folder for the pictures, or --video, a film"
        raise UsageError(f"{problem}; see sehdr-warp render --help")
    flags = changed_flags(args.film)
    if args.out is not None and may_move(args.cameras):
        flags = [flag for flag in flags if flag != "--fps"]  # Files of a moving camera state it, too.
    if args.video is None and flags:
        raise UsageError(f"{', '.join(flags)}: set for a film; name it with --video")
    if args.out is None and (flags := changed_flags(args.pictures)):
        raise UsageError(f"{', '.join(flags)}: set for pictures, which only --out writes")
    options = args.pictures
    check_options(
        args.cameras,
        args.size,
        aovs=options.aovs,
        evs=options.evs,
        exposures=options.exposures,
        pixel=options.pixel,
        multipart=options.multipart,
        ldr_brackets=options.ldr_brackets,
        group_by=options.group_by,
        ocio=options.ocio,
        view=options.view,
    )
    if args.count is not None and args.cameras not in PATHS:
        raise UsageError(f"--count {args.count}: set for an orbit or interpolation; name one with --cameras")
    check_rate(args.film.fps)
    if args.video is not None:
        film_library()
        film_format(args.video)
        check_absent(args.video, args.overwrite)


def _ramp(text: str | None) -> tuple[float, float]:
    """Return the stops of --ev-ramp, which is one number or two with a colon between."""
    if text is None:
        return 0.0, 0.0
    with suppress(ValueError):
        stops = [float(part) for part in text.split(":")]
        if len(stops) in (1, 2) and all(abs(stop) <= _MOST_STOPS for stop in stops):
            return stops[0], stops[-1]
    problem = f"is not stops from -{_MOST_STOPS} to {_MOST_STOPS}, with a colon between"
    raise InputError(f"--ev-ramp {text}", problem, "write for example --ev-ramp=-4:4")


def changed_flags(options: Any) -> list[str]:
    """Return the flags of a dataclass of options whose values are not the default."""
    names = [each.name for each in fields(options) if getattr(options, each.name) != each.default]
    return ["--" + name.replace("_", "-") for name in names]


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write report.html: figures; photo, scene and truth side by side; brackets; failures; and pictures."""

    run: Positional[Path]  # Folder of a run.
    out: Path  # Folder for the page and the pictures.
    data: str | None = None  # The photos, if they have moved since the training.
    overwrite: bool = False  # Replace files that exist.
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.


def run_report(args: Report) -> None:
    """Run `sehdr-warp report`."""
    from ..evaluation.evaluate import evaluate
    from .report.write import check_report_folder, write_report

    check_absent(args.out / "report.html", args.overwrite)
    check_report_folder(args.out)
    run = open_run(args.run, args.device)
    scene = load_run_scene_with_confidence(run, args.data)
    for path in write_report(run, scene, args.out, overwrite=args.overwrite, evaluation=evaluate(run, scene)):
        print(path)


@dataclass(frozen=True, kw_only=True)
class EnvironmentMap:
    """Write an environment map: the light that reaches a point of the scene from all directions."""

    removed_flags: ClassVar = {"--fill": "the option is --inpaint", "--white": "the option is --reference-white"}

    run: Positional[Path]  # Folder of a run, or a file of Gaussians.
    out: Path  # The file: .exr, or .hdr without alpha and confidence.
    at: str = "center"
    """x,y,z in upright coordinates or those of --axes (0,0,0: what most photos look at), camera:NAME, or center: the
    middle of the training cameras, or what they walk around."""
    size: int | None = None  # Pixels across, 2048 by default; for a cube those of one face, 512.
    layout: Literal["latlong", "cube"] = "latlong"
    """Latitude and longitude, twice as wide as high; or OpenEXR's six faces, one above the other."""
    world: WorldOptions = WorldOptions()
    beyond: float | None = None
    """Leave out what is nearer than this distance, in the units of --at: a CG object then stands in the place of the
    photographed one. By default 0, or, for the center of a walk around something, half the distance of the nearest
    photo."""
    inpaint: bool = False  # Fill directions that no photo covers with the light around them; alpha still marks them.
    colorspace: str = "rec709"
    """Primaries, always scene-linear: rec709, acescg, aces2065-1, rec2020, display-p3 or dci-p3."""
    reference_white: float | None = None
    """Value of display white in the file, such as 1, which suits a dome light; without it the file holds radiance."""
    pixel: Literal["half", "float"] = "half"  # Pixel type of an EXR file.
    overwrite: bool = False  # Replace a file that exists.
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.


def run_environment_map(args: EnvironmentMap) -> None:
    """Run `sehdr-warp envmap`."""
    from .images.colorspace import color_space
    from .lighting.map_center import check_place

    color_space(args.colorspace)  # Before anything is loaded
    check_place(args.at)
    from .lighting.environment_map import check_map, write_environment_map

    check_map(args.out, args.size, args.layout, args.world.axes, args.beyond, args.pixel)
    print(write_environment_map(open_scene(args.run, args.device), args.out, **_options(args)))


def _options(args: "EnvironmentMap | Lights") -> dict[str, Any]:
    """Return the options of a command line as arguments of the function that writes its file."""
    options = {name: value for name, value in vars(args).items() if name not in ("run", "out", "device", "world")}
    return options | vars(args.world)


@dataclass(frozen=True, kw_only=True)
class Lights:
    """List the lights that the photos clipped, with place, size, radiance and its deviation; and write them as lights.

    A USD file holds a SphereLight or RectLight for each, and a DomeLight for everything else.
    """

    run: Positional[Path]  # Folder of a run.
    out: Path | None = None
    """The file: .json, or .usda, with a map of the rest beside it. Without it the lights are only listed."""
    world: WorldOptions = WorldOptions()
    at: str = "center"
    """Place that is lit, as of envmap: that of a CG object. Lights that something hides from it are dimmer."""
    beyond: float | None = None  # Leave out what is nearer than this, as in envmap.
    unseen: Literal["inpaint", "black"] = "inpaint"
    """inpaint: directions of the map that no photo covers get the light around them; alpha still marks them."""
    reference_white: float | None = None
    """The one that the plates were rendered with, if any: lights and map then have their units."""
    overwrite: bool = False  # Replace files that exist.
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.


def run_lights(args: Lights) -> None:
    """Run `sehdr-warp lights`."""
    from .lighting.lights import lights_table, write_lights
    from .lighting.map_center import check_beyond, check_place
    from .lighting.unit import luminance_of_one
    from .world_transform import world_transform

    if args.out is None:
        of_files = "--reference-white", "--at", "--beyond", "--unseen"
        if flags := [flag for flag in changed_flags(args) if flag in of_files]:
            raise UsageError(f"{', '.join(flags)}: set for a file, which --out names")
        run = open_run(args.run, args.device)
        transform = world_transform(run, **vars(args.world))
        print(lights_table(run.find_lights(), luminance_of_one(run), transform))
        return
    check_place(args.at)
    check_beyond(args.beyond)
    run = open_run(args.run, args.device)
    for path in write_lights(run, args.out, **_options(args)):
        print(path)


@dataclass(frozen=True, kw_only=True)
class Meter:
    """Set the unit of a scene's light by one reading of a meter or a grey card, and store it with the run.

    Pictures and environment maps then state cd/m^2, and lights are written in cd/m^2.
    """

    run: Positional[Path]  # Folder of a run.
    view: str | None = None  # View in which the reading was taken. Without it, the unit of the run is printed.
    pixel: str | None = None  # x,y of the place from the upper left corner, in the size that the run has the view in.
    luminance: float | None = None  # Reading of a spot meter there, in cd/m^2.
    illuminance: float | None = None  # Reading of a lux meter on a matte surface there, such as a grey card.
    reflectance: float = 0.18  # Reflectance of that surface.
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.


def run_meter(args: Meter) -> None:
    """Run `sehdr-warp meter`."""
    from .lighting.unit import meter, read_light_unit

    run = open_run(args.run, args.device)
    if args.view is None:
        of_readings = "--pixel", "--luminance", "--illuminance", "--reflectance"
        if flags := [flag for flag in changed_flags(args) if flag in of_readings]:
            raise UsageError(f"{flags[0]}: needs the view of the reading; name it with --view")
        print(read_light_unit(run) or "no unit is set: radiance is relative")
        return
    if args.pixel is None:
        raise UsageError(f"--view {args.view}: needs the place of the reading; add --pixel x,y")
    x, *rest = parse_numbers("--pixel", args.pixel, float)
    if len(rest) != 1:
        raise UsageError(f"--pixel {args.pixel}: is not two numbers; write for example --pixel 812,440")
    reading = {"luminance": args.luminance, "illuminance": args.illuminance, "reflectance": args.reflectance}
    print(meter(run, args.view, (x, rest[0]), **reading))
