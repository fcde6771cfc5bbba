"""The command lines of `sehdr-warp render`, `report` and `export`. torch is imported when they run."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from ..files import check_absent
from ..training.commands import ensured_scene, open_run, open_scene


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
    """Render HDR EXR, previews and exposure brackets of a trained scene. Needs no photos."""

    cameras: str = "test"
    """test, train, all, orbit, interpolate, or cameras of your own: JSON, OpenUSD, or a COLMAP model's folder."""
    count: int = 60
    """Views of an orbit or interpolation."""
    size: str | None = None
    """Width and height in pixels, such as 1920x1080; by default the cameras' own."""
    passes: str = ""
    """Parts of the EXR files beside the picture, such as depth,normals: depth, position, normals, alpha, confidence."""
    evs: str | None = None
    """Brackets in stops from the photos' exposure, such as --evs=-4,-2,0,2,4."""
    exposures: str | None = None
    """Brackets as seconds (1/125), multiples of the photos' exposure (1/8x) or stops from it (-2ev): 1/125,1/30,1x."""
    multipart: bool = False
    """One multi-part EXR file for all exposures of a view."""
    ldr_brackets: Literal["jpeg", "png", "png16"] | None = None
    """Also write the brackets as simulated photos, through the camera response."""
    colorspace: str = "rec709"
    """Primaries of the EXR files, always scene-linear: rec709, acescg, aces2065-1, rec2020, display-p3 or dci-p3."""
    pixel: Literal["half", "float"] = "half"
    """Pixel type of the EXR files."""
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
    """Write the Gaussians as PLY, OpenUSD or glTF, for viewers and other tools; says what the file keeps."""

    out: Path
    """The file; its suffix decides: .ply, .glb (glTF), .usda, .usdc or .usdz (OpenUSD)."""
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
    pixel: Literal["half", "float"] = "half"
    """Pixel type of an EXR file."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""


def run_panorama(asked: Panorama) -> None:
    from .panorama import write_panorama

    options = {name: value for name, value in vars(asked).items() if name not in ("run", "out", "device")}
    print(write_panorama(open_scene(asked.run, asked.device), asked.out, **options))


def run_render(asked: Render) -> None:
    from .render_views import render_views

    options = {name: value for name, value in vars(asked).items() if name not in ("run", "device", "json")}
    written = render_views(open_scene(asked.run, asked.device), **options)
    if asked.json:
        print(json.dumps({"files": [str(path) for path in written]}))
    else:
        print(f"{asked.out}: {len(written)} files")


def run_report(asked: Report) -> None:
    from ..evaluation.evaluate import evaluate
    from .light_pictures import WITHOUT_GAIN_MAPS, gain_maps
    from .report import write_report

    run = open_run(asked.run, asked.device)
    scene = ensured_scene(run, asked.data)
    check_absent(asked.out / "report.html", asked.overwrite)
    for path in write_report(run, scene, asked.out, overwrite=asked.overwrite, evaluation=evaluate(run, scene)):
        print(path)
    if not gain_maps():
        print(f"its pictures are plain JPEG; Ultra HDR needs imagecodecs: {WITHOUT_GAIN_MAPS}")


def run_export(asked: Export) -> None:
    _export(asked.run, asked.out, asked.file, cameras=asked.cameras, overwrite=asked.overwrite)


def run_convert(asked: Convert) -> None:
    from ..splats import check_suffix

    check_suffix(asked.source)
    _export(asked.source, asked.out, asked.file, overwrite=asked.overwrite)


def _export(source: Path, out: Path, asked: _SplatFile, **options) -> None:
    from ..field.exposure import exposure_times
    from ..splats import check_suffix
    from .export import export

    check_suffix(out)  # Before the scene is opened.
    run = open_scene(source, asked.device)
    time = None if asked.exposure is None else exposure_times(run.base_time, asked.exposure)[0]
    print(export(run, out, kind=asked.kind, exposure_time=time, degree=asked.degree, **options))
