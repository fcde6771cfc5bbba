"""The command `sehdr-warp`: parses, calls, prints. What needs torch is imported by the commands that need it."""

import json
import os
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from . import __version__
from .arguments import say
from .bench.commands import Bench, run_bench
from .check.commands import Check, run_check
from .errors import InputError, SehdrError
from .quiet import silence_exit
from .synth.commands import Synth, run_synth
from .training.commands import Train, run_train

Positional = tyro.conf.Positional


@dataclass(frozen=True)
class Render:
    """Render a trained scene: HDR EXR, previews, and exposure brackets. Needs no photos."""

    run: Positional[Path]
    """Folder of a run."""
    out: Path
    """Folder for the images."""
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
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    overwrite: bool = False
    """Replace files that exist."""
    json: bool = False
    """Print the written files as JSON on standard output."""


@dataclass(frozen=True)
class Evaluate:
    """Compare a trained scene with its held-out photos and, where there is some, with HDR truth."""

    run: Positional[Path]
    """Folder of a run."""
    json: Path | None = None
    """Also write the figures to this file."""
    data: str | None = None
    """The photos, if they have moved since the training."""
    lpips: Path | None = None
    """Folder with LPIPS weights; without, LPIPS is null."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    overwrite: bool = False
    """Replace the file of --json."""


@dataclass(frozen=True)
class Export:
    """Write the Gaussians as PLY: `hdr` with scene-linear colours, `ldr` with the display colours of 3DGS viewers."""

    run: Positional[Path]
    """Folder of a run."""
    out: Path
    """The PLY file."""
    kind: Literal["hdr", "ldr"] = "hdr"
    """Which colours."""
    overwrite: bool = False
    """Replace the file if it exists."""


@dataclass(frozen=True)
class Report:
    """Compare input, tone-mapped HDR and truth in a picture, and plot error against training time."""

    run: Positional[Path]
    """Folder of a run."""
    out: Path
    """Folder for the pictures."""
    data: str | None = None
    """The photos, if they have moved since the training."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    overwrite: bool = False
    """Replace files that exist."""


Command = (
    Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Evaluate, tyro.conf.subcommand("eval")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[Synth, tyro.conf.subcommand("synth")]
)


def main(arguments: list[str] | None = None) -> None:
    """Runs a command line and exits: 0 done, 1 an error the user can act on, 2 wrong usage, 130 interrupted, 141 nobody
    reads its output any more."""
    # torch's OpenMP threads spin while they wait, which on a processor shared with other programs costs a training on
    # the CPU most of its time; read once, when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    silence_exit()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["--version"]:
        print(f"sehdr-warp {__version__}")
        sys.exit(0)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    command = tyro.cli(
        Command,
        prog="sehdr-warp",
        args=arguments,
        description="Scene-linear HDR Gaussian scenes from photos of one exposure. "
        "--version prints the version; --debug shows where an error comes from.",
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
    )
    try:
        _COMMANDS[type(command)](command)
        sys.stdout.flush()
    except SehdrError as error:
        if debug:
            traceback.print_exc()
        print(f"sehdr-warp: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("sehdr-warp: interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        # As of `sehdr-warp ... | head`; Python would complain again when it closes what nobody reads.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    sys.exit(0)


def _render(command: Render) -> None:
    from .output.render_views import render_views

    written = render_views(
        _load_run(command.run, command.device),
        command.out,
        cameras=command.cameras,
        count=command.count,
        evs=command.evs,
        exposures=command.exposures,
        multipart=command.multipart,
        colorspace=command.colorspace,
        pixel=command.pixel,
        ldr_brackets=command.ldr_brackets,
        overwrite=command.overwrite,
        progress=say,
    )
    if command.json:
        print(json.dumps({"files": [str(path) for path in written]}))
    else:
        print(f"{command.out}: {len(written)} files")


def _evaluate(command: Evaluate) -> None:
    from .evaluation.evaluate import evaluate
    from .evaluation.table import format_table
    from .files import check_absent, write_json
    from .training.confidence import ensure_confidence

    if command.json is not None:
        check_absent(command.json, command.overwrite)
    run = _load_run(command.run, command.device)
    scene = _scene_of(run, command.data)
    ensure_confidence(run, scene, say)
    result = evaluate(run, scene, lpips_weights=command.lpips, progress=say)
    if command.json is not None:
        write_json(command.json, result, command.overwrite)
    print(format_table(result))


def _export(command: Export) -> None:
    from .output.ply import write_ply

    run = _load_run(command.run, "cpu")
    path = write_ply(command.out, run, kind=command.kind, overwrite=command.overwrite, progress=say)
    print(path)


def _report(command: Report) -> None:
    from .output.report import write_report
    from .training.confidence import ensure_confidence

    run = _load_run(command.run, command.device)
    scene = _scene_of(run, command.data)
    ensure_confidence(run, scene, say)
    for path in write_report(run, scene, command.out, overwrite=command.overwrite):
        print(path)


_COMMANDS = {
    Train: run_train,
    Render: _render,
    Evaluate: _evaluate,
    Export: _export,
    Report: _report,
    Bench: run_bench,
    Check: run_check,
    Synth: run_synth,
}


def _load_run(path: Path, device: str | None):
    from .training.run import load_run
    from .training.train import pick_device

    return load_run(path, device=pick_device(device))


def _scene_of(run, data: str | None):
    """The scene a run was trained on, read again in the same way."""
    from .scene import is_embedded, load_scene

    place = data or run.data.get("path")
    if place is None:
        raise SehdrError(f"{run.path}: does not say where its photos are; give --data")
    if data is None and not is_embedded(place) and not Path(place).is_dir():
        raise InputError(place, "the photos of the run are no longer here", "say where they are with --data")
    return load_scene(
        place,
        exposure_index=run.data.get("exposure_index"),
        max_size=run.data.get("max_size"),
        response=_curve_of(run),
    )


def _curve_of(run):
    """The response that the photos of the training were developed with: a learned one was not known then."""
    options = run.config.response
    return "learned" if options.name == "learned" else run.response


if __name__ == "__main__":
    main()
