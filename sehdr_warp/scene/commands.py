"""Commands `sehdr-warp scenes`, `responses` and `calibrate`. torch is imported when they run."""

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional


@dataclass(frozen=True)
class Scenes:
    """List the scenes that come with the package or a checkout of it, for train and load_scene."""

    json: bool = False  # Print them as JSON.


@dataclass(frozen=True)
class Responses:
    """List the camera responses that have a name, and what each is for."""

    json: bool = False  # Print them as JSON.


@dataclass(frozen=True)
class Calibrate:
    """Measure a camera's response from an exposure stack: photos of one still scene at several exposure times."""

    stack: Positional[Path]  # Folder of photos; their times come from EXIF, exposures.json or --exposures.
    out: Path  # CSV file for the curve, for --response; a plot goes beside it (.png).
    exposures: str | None = None  # Times in the order of the files' names, such as 1/500,1/125,1/30.
    channel: Literal["red", "green", "blue", "each"] | None = None
    """One channel alone, or a curve for each; by default one curve for all three."""
    overwrite: bool = False  # Replace files that exist.


def run_scenes(args: Scenes) -> None:
    """Print the names; `embedded` alone means embedded:room."""
    from . import embedded_scenes

    names = [f"embedded:{name}" for name in embedded_scenes()]
    print(json.dumps(names) if args.json else "\n".join(names))


def run_responses(args: Responses) -> None:
    """Print the names of responses with their meaning."""
    from ..response import response_names

    names = response_names()
    if args.json:
        print(json.dumps(names))
        return
    names["colour:NAME"] = "a camera's encoding of colour-science, such as colour:S-Log3"
    names["FILE"] = "CSV, JSON, .cube or EMoR's layout, FILE:INDEX of DoRF's; `sehdr-warp calibrate` makes one"
    for name, meaning in names.items():
        print(f"{name:<12}  {meaning}")


def run_calibrate(args: Calibrate) -> None:
    """Calibrate the response of an exposure stack and write it."""
    from ..model.exposure import seconds
    from .exposure.stack import calibrate

    times = None if args.exposures is None else seconds(args.exposures, "--exposures")
    calibrate(args.stack, times=times, channel=args.channel, out=args.out, overwrite=args.overwrite)
    curve_file = shlex.quote(str(args.out))
    print(f"{args.out}: take it with --response {curve_file}; the plot is {args.out.with_suffix('.png')}")
