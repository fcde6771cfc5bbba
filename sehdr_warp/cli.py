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
from .bench.commands import Bench, run_bench
from .check.commands import Check, run_check
from .errors import InputError, SehdrError
from .synth.commands import Synth, run_synth

Positional = tyro.conf.Positional


@dataclass(frozen=True)
class Train:
    """Train a scene from photos of one exposure."""

    data: Positional[str]
    """Folder of photos: COLMAP, transforms.json, HDR-NeRF, HDR-GS, LLFF or bare photos; `embedded` is the room that
    comes with the package, `embedded:NAME` another of its scenes."""
    out: Path
    """Folder for the run."""
    preset: str | None = None
    """default, fast, demo, paper, a rival (paper-truth, hdr-gs, hdr-gs-truth, 3dgs, truth, predicted), or a TOML file;
    with --resume the run's own config."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    exposure_index: int | None = None
    """Which exposure to train on where a view has several; by default the middle one."""
    response: str | None = None
    """Camera response: a name (srgb, gamma-2.2, hdr-nerf ...), a file, or auto."""
    predict_hdr: str | None = None
    """Train on single-image predictions in place of HDR truth: kovaleski-oliveira, a folder of predicted EXR files named
    as the views, or a TorchScript (.pt) or ONNX (.onnx) file; the preset is then `predicted` unless you name one."""
    iterations: int | None = None
    """Training steps; all schedules scale with it."""
    max_size: int | None = None
    """Longest side of the photos, in pixels; larger ones are reduced."""
    seed: int | None = None
    """Seed of every random number."""
    resume: bool = False
    """Continue the run in --out from its newest checkpoint."""
    overwrite: bool = False
    """Replace the run in --out."""
    tensorboard: bool = False
    """Write TensorBoard event files into the run."""
    json: bool = False
    """Print the result as JSON on standard output."""


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
    """Exposure brackets in stops from the photos' exposure, such as --evs=-4,-2,0,2,4."""
    exposures: str | None = None
    """Exposure brackets in seconds, such as 0.125,0.5,2,8,32."""
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
    """Runs a command line and exits: 0 done, 1 an error the user can act on, 2 wrong usage, 130 interrupted."""
    # torch's OpenMP threads spin while they wait, which on a processor shared with other programs costs a training on
    # the CPU most of its time; read once, when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
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
    except SehdrError as error:
        if debug:
            traceback.print_exc()
        print(f"sehdr-warp: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("sehdr-warp: interrupted", file=sys.stderr)
        sys.exit(130)
    sys.exit(0)


def _train(command: Train) -> None:
    from .scene import load_scene
    from .training.prediction import check_predictor
    from .training.run import check_folder
    from .training.train import pick_device, train

    # What can be refused is refused before the photos are read, which may take minutes.
    resumed = check_folder(command.out, resume=command.resume, overwrite=command.overwrite)
    config, device = _config(command, resumed), pick_device(command.device)
    if config.loss.predictor:
        check_predictor(config.loss.predictor)
    data = {"path": _absolute(command.data), "exposure_index": command.exposure_index, "max_size": command.max_size}
    scene = load_scene(
        command.data,
        exposure_index=command.exposure_index,
        max_size=command.max_size,
        cache=_cache_beside(command.out),
        progress=_say,
        **_curves(config.response.name),
    )
    for note in scene.notes:
        _say(note)
    run = train(
        scene,
        command.out,
        config,
        device=device,
        resume=command.resume,
        overwrite=command.overwrite,
        tensorboard=command.tensorboard,
        data=data,
    )
    summary = run.summary() | {"run": str(run.path), "metrics": run.metrics()}
    if command.json:
        print(json.dumps(summary))
    else:
        seconds, count = summary["train_seconds"], summary["gaussians"]
        print(f"{run.path}: {run.iterations} iterations, {count} Gaussians, {seconds:.1f} s on {summary['device']}")


def _config(command: Train, resumed: bool):
    from .training.config_files import load_config, override_config, read_config_json
    from .training.run import CONFIG

    given = {
        "response.name": command.response,
        "loss.predictor": _predictor(command.predict_hdr),
        "schedule.iterations": command.iterations,
        "seed": command.seed,
    }
    overrides = {name: value for name, value in given.items() if value is not None}
    if resumed and command.preset is None:
        path = command.out / CONFIG
        return override_config(read_config_json(path), overrides, path)
    preset = command.preset or ("default" if command.predict_hdr is None else "predicted")
    return load_config(preset, overrides)


def _render(command: Render) -> None:
    from .output.render_views import render_views

    written = render_views(
        _load_run(command.run, command.device),
        command.out,
        cameras=command.cameras,
        count=command.count,
        evs=_numbers("--evs", command.evs),
        exposures=_numbers("--exposures", command.exposures),
        multipart=command.multipart,
        colorspace=command.colorspace,
        pixel=command.pixel,
        ldr_brackets=command.ldr_brackets,
        overwrite=command.overwrite,
        progress=_say,
    )
    if command.json:
        print(json.dumps({"files": [str(path) for path in written]}))
    else:
        print(f"{command.out}: {len(written)} files")


def _evaluate(command: Evaluate) -> None:
    from .evaluation.evaluate import evaluate
    from .evaluation.table import format_table
    from .output.files import check_absent, write_json

    if command.json is not None:
        check_absent(command.json, command.overwrite)
    run = _load_run(command.run, command.device)
    result = evaluate(run, _scene_of(run, command.data), lpips_weights=command.lpips, progress=_say)
    if command.json is not None:
        write_json(command.json, result, command.overwrite)
    print(format_table(result))


def _export(command: Export) -> None:
    from .output.ply import write_ply

    path = write_ply(command.out, _load_run(command.run, "cpu"), kind=command.kind, overwrite=command.overwrite)
    print(path)


def _report(command: Report) -> None:
    from .output.report import write_report

    run = _load_run(command.run, command.device)
    for path in write_report(run, _scene_of(run, command.data), command.out, overwrite=command.overwrite):
        print(path)


_COMMANDS = {
    Train: _train,
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
        cache=_cache_beside(run.path),
        **_curves_of(run),
        progress=_say,
    )


def _curves(response: str) -> dict:
    """load_scene's decode and encode for a response that is known before the photos are read."""
    if response == "auto":
        return {}
    from .model.response import response_by_name

    curve = response_by_name(response)
    return {"decode": curve.decode, "encode": curve.encode}


def _curves_of(run) -> dict:
    """load_scene's decode and encode for a trained run: its response's, or, learned, those it was trained with."""
    if run.config.response.form == "mlp":
        return _curves(run.config.response.name)
    return {"decode": run.response.decode, "encode": run.response.encode}


def _cache_beside(run: Path) -> Path:
    """Where structure from motion keeps its results: beside the run, so that a second run finds them too."""
    return run.absolute().parent / f"{run.name}.cache"


def _absolute(data: str) -> str:
    from .scene import is_embedded

    return data if is_embedded(data) else str(Path(data).absolute())


def _predictor(text: str | None) -> str | None:
    """A predictor for the config, which outlives this folder: paths in full, names as they are."""
    return str(Path(text).absolute()) if text is not None and Path(text).exists() else text


def _numbers(flag: str, text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(item) for item in text.split(","))
    except ValueError:
        raise SehdrError(f"{flag} {text}: not numbers separated by commas; write for example {flag}=-2,0,2") from None


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
