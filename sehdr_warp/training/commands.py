"""The command line of `sehdr-warp train`: what may be asked for, and the call. torch is imported when it runs."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..arguments import say
from ..errors import SehdrError


@dataclass(frozen=True)
class Train:
    """Train a scene from photos of one exposure."""

    data: tyro.conf.Positional[str]
    """Folder of photos: COLMAP, transforms.json, HDR-NeRF, HDR-GS, LLFF or bare photos; `embedded` is the room that
    comes with the package, `embedded:NAME` another of its scenes."""
    out: Path | None = None
    """Folder for the run; needed for all but --plan-only."""
    preset: str | None = None
    """default, fast, demo, paper, a rival (paper-truth, hdr-gs, hdr-gs-truth, gauss-hdr, 3dgs, truth, predicted), or a
    TOML file; with --resume the run's own config."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    exposure_index: int | None = None
    """Which exposure to train on where a view has several; by default the middle one."""
    response: str | None = None
    """Camera response: a name (srgb, gamma-2.2, hdr-nerf ...), a file, or auto."""
    predict_hdr: str | None = None
    """Train on single-image predictions in place of HDR truth: kovaleski-oliveira, a folder of predicted EXR files
    named as the views, or a TorchScript (.pt) or ONNX (.onnx) file; the preset is then `predicted` unless you name
    one."""
    iterations: int | None = None
    """Training steps; all schedules scale with it."""
    max_size: int | None = None
    """Longest side of the photos, in pixels; larger ones are reduced."""
    seed: int | None = None
    """Seed of every random number."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Another value of any field of the config, such as loss.clipping=false; may be given several times. A value that
    the scene contradicts is refused, and a plan leaves these fields as they are."""
    plan: bool = False
    """Read the scene first and leave out what it does not need, on top of the preset."""
    plan_only: bool = False
    """Print the plan with its reasons and train nothing."""
    resume: bool = False
    """Continue the run in --out from its newest checkpoint."""
    overwrite: bool = False
    """Replace the run in --out."""
    tensorboard: bool = False
    """Write TensorBoard event files into the run."""
    json: bool = False
    """Print the result as JSON on standard output."""


def run_train(command: Train) -> None:
    from .prediction import check_predictor
    from .run import check_folder
    from .train import pick_device, train

    if command.plan_only:
        _print_plan(command)
        return
    if command.out is None:
        raise SehdrError("train needs a folder for the run: give --out, or --plan-only to train nothing")
    # What can be refused is refused before the photos are read, which may take minutes.
    resumed = check_folder(command.out, resume=command.resume, overwrite=command.overwrite)
    config, device = _config(command, resumed), pick_device(command.device)
    if config.loss.predictor:
        check_predictor(config.loss.predictor)
    data = {"path": _absolute(command.data), "exposure_index": command.exposure_index, "max_size": command.max_size}
    run = train(
        _load(command, config),
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
        if summary.get("plan"):
            print("plan: " + "; ".join(f"{name} {choice}" for name, choice in summary["plan"].items()))


def _print_plan(command: Train) -> None:
    """The plan alone: as a table, or with --json as JSON on standard output."""
    from .plan import make_plan

    config = _config(command, resumed=False)
    plan = make_plan(_load(command, config), config)
    print(json.dumps(plan.to_dict()) if command.json else plan.table())


def _load(command: Train, config):
    """The scene, its notes told."""
    from ..scene import load_scene

    scene = load_scene(
        command.data,
        exposure_index=command.exposure_index,
        max_size=command.max_size,
        **developed_by(config),
    )
    for note in scene.notes:
        say(note)
    return scene


def _config(command: Train, resumed: bool):
    from .config_files import load_config, override_config, parse_setting, read_config_json
    from .run import CONFIG

    given = {
        "response.name": command.response,
        "loss.predictor": _predictor(command.predict_hdr),
        "schedule.iterations": command.iterations,
        "seed": command.seed,
    }
    settings = dict(parse_setting(text) for text in command.set)
    overrides = {name: value for name, value in given.items() if value is not None} | settings
    if command.plan or command.plan_only:
        overrides["plan.enabled"] = True
    if resumed and command.preset is None:
        path = command.out / CONFIG
        return override_config(read_config_json(path), overrides, path)
    preset = command.preset or ("default" if command.predict_hdr is None else "predicted")
    config = load_config(preset, overrides)
    stated = overrides if config.plan.enabled else settings
    kept = {*config.plan.keep, *(path for path in stated if not path.startswith("plan."))}
    return override_config(config, {"plan.keep": sorted(kept)})


def developed_by(config) -> dict:
    """load_scene's choice of a response, as the config has it."""
    options = config.response
    return {"response": options.name, "method": options.method, "candidates": options.candidates}


def _absolute(data: str) -> str:
    from ..scene import is_embedded

    return data if is_embedded(data) else str(Path(data).absolute())


def _predictor(text: str | None) -> str | None:
    """A predictor for the config, which outlives this folder: paths in full, names as they are."""
    return str(Path(text).absolute()) if text is not None and Path(text).exists() else text
