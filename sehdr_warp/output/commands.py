"""The command lines of `sehdr-warp render`, `report` and `export`. torch is imported when they run."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from ..training.commands import ensured_scene, open_run


@dataclass(frozen=True, kw_only=True)
class _OfRun:
    run: Positional[Path]
    """Folder of a run."""
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
    """test, train, all, orbit, interpolate, or a JSON file of cameras."""
    count: int = 60
    """Views of an orbit or interpolation."""
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
    """Compare input, tone-mapped HDR and truth in pictures, and plot error against training time."""

    data: str | None = None
    """The photos, if they have moved since the training."""


@dataclass(frozen=True, kw_only=True)
class Export(_OfRun):
    """Write the Gaussians as PLY: hdr with scene-linear colors, ldr with the display colors of 3DGS viewers."""

    out: Path
    """The PLY file."""
    kind: Literal["hdr", "ldr"] = "hdr"
    """Which colors."""


def run_render(asked: Render) -> None:
    from .render_views import render_views

    options = {name: value for name, value in vars(asked).items() if name not in ("run", "device", "json")}
    written = render_views(open_run(asked.run, asked.device), **options)
    if asked.json:
        print(json.dumps({"files": [str(path) for path in written]}))
    else:
        print(f"{asked.out}: {len(written)} files")


def run_report(asked: Report) -> None:
    from .report import write_report

    run = open_run(asked.run, asked.device)
    for path in write_report(run, ensured_scene(run, asked.data), asked.out, overwrite=asked.overwrite):
        print(path)


def run_export(asked: Export) -> None:
    from .ply import export

    print(export(open_run(asked.run, "cpu"), asked.out, kind=asked.kind, overwrite=asked.overwrite))
