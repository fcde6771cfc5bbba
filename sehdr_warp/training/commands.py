"""The command line of `sehdr-warp train`, which imports torch when it runs."""

import json
import logging
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro
from tyro.conf import Positional

from ..errors import InputError, SehdrError, UsageError, missing
from ..files import require_text
from ..runs.config_files import GONE, RENAMED, load_config, override_config, with_iterations_of
from ..runs.config_flags import flag_of, flags_type, parse_field, used_fields
from ..runs.device import pick_device
from ..runs.open import PhotoRequest, load_scene_and_log_notes
from ..runs.values import SCENE_OPTIONS, LoadArguments

if TYPE_CHECKING:
    from ..runs.config import Config
    from ..runs.run import Run
    from .launch import RankInfo
    from .ranks import Ranks
    from .trainer import Trainer
    from .training_progress import TrainingProgress

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SceneOptions:
    """"""  # noqa: D419  (here and below: a text would be one more line of the help)

    response: str | None = None
    """Camera response: a name of `sehdr-warp responses`, a file, auto (the default) or learned."""
    max_size: int | None = None  # Longest side of the photos, in pixels; larger ones are reduced.
    holdout: int | None = None
    """Hold out every Nth view for testing, 0 none; by default what the set states, or every 8th."""
    exposure_index: int | None = None  # Which exposure to take if a view has several; by default the middle one.


@dataclass(frozen=True)
class TrainingOptions:
    """"""  # noqa: D419

    preset: str | None = None
    """A name of `sehdr-warp presets` or a TOML file. (default: default, or what --resume continues)"""
    iterations: int | None = None  # Steps; by default planned from the photos.
    seed: int | None = None  # Seed of every random number.
    blocks: str | None = None  # Train in N blocks of space, merged; auto chooses N.
    plan_only: bool = False  # Print the plan and its cost; train nothing.


@dataclass(frozen=True)
class OutputOptions:
    """"""  # noqa: D419

    out: Path | None = None  # Folder for the run.
    resume: bool = False  # Continue the run in --out, with its scene and config.
    overwrite: bool = False  # Replace the run in --out.
    tensorboard: bool = False  # Write TensorBoard event files into the run.
    view: bool = False  # Serve the page of `view` during the training, from port 8080.
    json: bool = False  # Print the result as JSON on standard output.


@dataclass(frozen=True)
class MachineOptions:
    """"""  # noqa: D419

    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.
    gpus: int = 1  # GPUs, for one training or for blocks.
    slurm: str | None = None  # Submit blocks to SLURM: partition=gpu,time=MINUTES.


@dataclass(frozen=True)
class Train:
    """Train a scene from photos of one exposure. A plan leaves out what it does not need, and keeps what you set."""

    removed_flags: ClassVar[Mapping[str, str]] = {
        **{flag_of(path): advice for path, advice in GONE.items()},
        **{flag_of(path): f"write {flag_of(name)}" for path, name in RENAMED.items()},
    }

    data: Annotated[Positional[str | None], tyro.conf.arg(metavar="SCENE", help_behavior_hint="")] = None
    """Folder of photos, bare or with poses, or a video; `embedded` is a demo."""
    scene: SceneOptions = SceneOptions()
    training: TrainingOptions = TrainingOptions()
    output: OutputOptions = OutputOptions()
    machine: MachineOptions = MachineOptions()
    # Text of each config field whose flag was used: {table: {path: text}}, see used_fields().
    fields: Annotated[flags_type(), tyro.conf.arg(name="")] = field(default_factory=dict)  # pyright: ignore[reportInvalidTypeForm]


def run_train(args: Train, argv: Sequence[str]) -> None:
    """Train, or print the plan, and print what was written and what to do next.

    With --plan-only, _print_plan() is all. With --blocks, _train_blocks() starts processes of its own. With --gpus,
    launch_ranks() starts a process for each GPU: it runs `argv`, the words of the command line, again and enters this
    function as a rank, as under torchrun. A rank goes to _train_on_rank(), a single process to _train().
    """
    _check_options(args)
    from .launch import device_of_rank, launch_ranks, rank_from_environment

    gpus, rank_info, uses_blocks = args.machine.gpus, rank_from_environment(), _uses_blocks(args)
    if args.training.plan_only:
        if rank_info is None or rank_info.rank == 0:
            _print_plan(args)
        return
    if uses_blocks:
        if rank_info is not None:
            raise UsageError("--blocks starts its own processes; leave torchrun out")
        if (run := _train_blocks(args)) is not None:
            _print_result(args, run)
            return
        argv = _without_blocks(argv)  # One training is enough, as --blocks auto found.
    if rank_info is not None:
        _train_on_rank(args, rank_info)
    elif gpus > 1:
        device_of_rank(gpus - 1, args.machine.device)  # Raises an error if there are fewer.
        launch_ranks(gpus, _run_in_rank, list(argv))
    else:
        _train(args)


def _check_options(args: Train) -> None:
    """Raise an error for a missing SCENE or options that contradict each other, before torch is imported."""
    from ..scene import is_embedded

    data, options, output = args.data, args.training, args.output
    if data is None and not output.resume:
        raise UsageError("train needs SCENE, a folder of photos or `embedded`; see sehdr-warp train --help")
    if data is not None and not is_embedded(data) and not os.path.lexists(data):
        raise missing(Path(data), "not found", "give a folder of photos, or 'embedded'")
    if args.machine.gpus < 1:
        raise UsageError(f"--gpus {args.machine.gpus} is not 1 or more")
    if data is not None and all(os.path.isfile(os.path.join(data, name)) for name in ("config.json", "run.json")):
        steps = "" if options.iterations is None else f" --iterations {options.iterations}"
        command = f"sehdr-warp train --resume --out {shlex.quote(data)}{steps}"
        raise UsageError(f"{data}: is a run, not photos; {command} continues it")
    if output.resume and output.overwrite:
        raise UsageError("--resume continues the run in --out, --overwrite replaces it; leave one out")
    if options.plan_only and output.resume:
        raise UsageError("--plan-only plans a new training; leave --resume out")
    if output.out is None and not options.plan_only:
        raise UsageError("train needs --out, a folder for the run; or --plan-only, to train nothing")
    if options.blocks is not None and (output.view or output.tensorboard):
        raise UsageError("--view and --tensorboard are without effect with --blocks; view the run when it is done")


def _train_on_rank(args: Train, rank_info: "RankInfo") -> None:
    """Train together with other ranks: rank 0 by _train(), the others by the training that it sends them."""
    from .launch import device_of_rank
    from .ranks import join_ranks
    from .workers import train_as_worker

    if args.machine.gpus not in (1, rank_info.local_count):
        raise UsageError(f"--gpus {args.machine.gpus}, but {rank_info.local_count} ranks were started; leave it out")
    with join_ranks(rank_info, device_of_rank(rank_info.local_rank, args.machine.device)) as ranks:
        if ranks.is_main_process:
            _train(args, ranks)
        else:
            train_as_worker(ranks, _photo_path(args))


def _run_in_rank(argv: list[str]) -> None:
    """Run a command line in the process of a rank."""
    from ..cli import main
    from ..process import prepare

    prepare()
    main(argv)


def _train(args: Train, ranks: "Ranks | None" = None) -> None:
    """Train or resume a run in this process, with `ranks` as rank 0 of them."""
    from ..console import run_with_progress
    from ..response import Response
    from ..runs.run_writer import RunWriter
    from .advice import advice_on, options_of_run
    from .hdr_truth import check_dataset_truth
    from .process_settings import precompiling
    from .train import create_trainer, resumed_config

    output, out = args.output, args.output.out
    assert out is not None, "run_train() refuses it"
    # What can be refused is refused before the photos are read, which may take minutes.
    folder = RunWriter(out)
    resumes = folder.check_start(resume=output.resume, overwrite=output.overwrite)
    if output.resume and not resumes:
        if args.data is None:
            raise SehdrError(f"{out}: holds no run to resume; give SCENE, a folder of photos, to begin one there")
        log.info("%s holds no run yet: a training begins there", out)
    info, saved_config = folder.read_info() if resumes else {}, folder.read_config() if resumes else None
    data, config = _load_arguments(args, info.get("data")), _config(args, saved_config)
    config = config if saved_config is None else resumed_config(folder, config)
    request = PhotoRequest(data, config.load_options)
    if saved_config is not None:
        request = request.of_run(saved_config, Response.from_dict(info["response"]), folder.read_cameras())
        if args.scene.holdout is not None:  # Its splits are compared with the run's, in place of these.
            request = replace(request, cameras=())
    check_dataset_truth(data, config)
    device = pick_device(args.machine.device) if ranks is None else ranks.device
    with nullcontext() if device.type != "cpu" else precompiling(config):
        if ranks is not None and ranks.info.several_nodes:
            ranks.request_photos(request)
        flags = {name: getattr(output, name) for name in ("resume", "overwrite", "tensorboard")}
        # No variable holds the scene: compensated photos would be in memory twice.
        trainer = create_trainer(request.load(), out, config, device=device, data=data, ranks=ranks, **flags)
        if trainer.iteration >= trainer.total:
            log.info("all %d iterations are done: nothing is left to train", trainer.total)
        with _serve(trainer, out) if output.view else nullcontext(trainer) as steps:
            run_with_progress(steps, trainer.total)  # Iterating the trainer trains.
    options = {"response": args.scene.response, "preset": args.training.preset, "seed": args.training.seed}
    command_options = options_of_run(trainer.run) if output.resume else used_fields(args.fields) | options
    command_options |= {"device": args.machine.device, "gpus": args.machine.gpus if args.machine.gpus > 1 else None}
    _print_result(args, trainer.run, advice_on(trainer, data, command_options))


def _serve(trainer: "Trainer", out: Path) -> "AbstractContextManager[Iterable[TrainingProgress]]":
    """Serve the page of --view; iterating the result trains, and answers browsers between steps."""
    from ..viewer.live import serve_training  # With its HTTP server, which other trainings do without.

    return serve_training(trainer, str(out))


def _print_plan(args: Train) -> None:
    """Print the plan of a training and its cost."""
    from ..blocks.estimate import estimate
    from .plan import make_plan

    data, config, device = _load_arguments(args, None), _config(args, None), pick_device(args.machine.device)
    plan = make_plan(load_scene_and_log_notes(data, **config.load_options), config, device)
    choices, recommended = estimate(plan, config, device, args.machine.gpus)
    cost = {"choices": [choice.to_dict() for choice in choices], "recommended": recommended}
    lines = plan.table(), "estimated cost", *(choice.line() for choice in choices), f"recommended: {recommended}"
    print(json.dumps(plan.to_dict() | {"cost": cost}) if args.output.json else "\n".join(lines))


def _print_result(args: Train, run: "Run", advice: Sequence[str] = ()) -> None:
    """Print what a training wrote, and advice on it."""
    summary = run.summary() | {"run": str(run.path), "metrics": run.metrics(), "advice": [*advice]}
    print(json.dumps(summary) if args.output.json else "\n".join([next_commands(run.path, summary), *advice]))


def _uses_blocks(args: Train) -> bool:
    """Return whether a command line trains in blocks, as --resume of such a run does too; refuse what cannot be."""
    from ..blocks.block_plan import MOST_BLOCKS
    from ..blocks.train import is_in_blocks

    blocks, output = args.training.blocks, args.output
    if blocks is not None:
        digits = blocks.isdecimal() and len(blocks) <= len(str(MOST_BLOCKS))
        if blocks != "auto" and not (digits and 2 <= int(blocks) <= MOST_BLOCKS):
            raise UsageError(f"--blocks {blocks:.60} is neither auto nor a number from 2 to {MOST_BLOCKS}")
        return True
    if output.out is not None and is_in_blocks(output.out) and not args.training.plan_only:
        if output.overwrite:
            raise InputError(output.out, "holds a training in blocks", "choose another folder, or add --blocks")
        return output.resume
    if args.machine.slurm is not None:
        raise UsageError("--slurm needs --blocks")
    return False


def _train_blocks(args: Train) -> "Run | None":
    """Train or resume a run in blocks; None, with nothing begun, if `auto` finds that one training is enough."""
    from ..arguments import parse_pairs
    from ..blocks.block_plan import BlockPlan
    from ..blocks.jobs import check_devices
    from ..blocks.train import is_in_blocks, train_in_blocks

    output, machine = args.output, args.machine
    assert output.out is not None, "_check_options() refuses it"
    device = pick_device(machine.device)
    if machine.slurm is None:
        check_devices(device, machine.gpus)
    plan = BlockPlan.read(output.out) if output.resume and is_in_blocks(output.out) else None
    blocks = args.training.blocks
    return train_in_blocks(
        _load_arguments(args, None if plan is None else plan.data),
        output.out,
        _config(args, None if plan is None else plan.config),
        int(blocks) if blocks not in (None, "auto") else None,
        device=device,
        gpus=machine.gpus,
        slurm=parse_pairs("--slurm", machine.slurm),
        slurm_device="cpu" if device.type == "cpu" and machine.device is not None else None,
        resume=output.resume,
        overwrite=output.overwrite,
    )


def _without_blocks(argv: Sequence[str]) -> list[str]:
    """Return a command line without `--blocks auto` or `--blocks=auto`."""
    pairs = zip(argv, ["", *argv], strict=False)
    return [word for word, before in pairs if before != "--blocks" and word.partition("=")[0] != "--blocks"]


def _photo_path(args: Train) -> str | None:
    """Return where the command line says that the photos are, as an absolute path or a name; None if it does not."""
    from ..scene import is_embedded

    if args.data is None or is_embedded(args.data):
        return args.data
    path = str(Path(args.data).absolute())
    require_text(path)
    return path


def _load_arguments(args: Train, saved: LoadArguments | None) -> LoadArguments:
    """Return where the photos are and how they are loaded: by the command line, or else as in the run to resume."""
    from ..scene import is_embedded

    options: dict = {"path": _photo_path(args)} | {name: getattr(args.scene, name) for name in SCENE_OPTIONS}
    if saved is not None:
        options = {name: saved.get(name) if value is None else value for name, value in options.items()}
        options |= {"views": views} if (views := saved.get("views")) else {}
    if options["path"] is None:
        raise SehdrError(f"{args.output.out}: does not say where its photos are; give SCENE")
    if args.data is None and not is_embedded(options["path"]) and not Path(options["path"]).exists():
        command = f"sehdr-warp train SCENE --resume --out {shlex.quote(str(args.output.out))}"
        raise InputError(options["path"], "the photos of the run are no longer here", f"say where they are: {command}")
    return LoadArguments(**options)


def _config(args: Train, saved: "Config | None") -> "Config":
    """Return the config of the preset, or that of the run that is resumed, with the fields of the command line."""
    options = args.training
    shortcuts = {"response.name": args.scene.response, "schedule.iterations": options.iterations, "seed": options.seed}
    overrides = {path: value for path, value in shortcuts.items() if value is not None}
    flags = {"response.name": "--response", "schedule.iterations": "--iterations", "seed": "--seed"}
    for path, text in used_fields(args.fields).items():
        overrides[path], flags[path] = parse_field(path, text), flag_of(path)
    if saved is not None and options.preset is None:
        return override_config(saved, overrides, flags=flags)
    config = load_config(options.preset or "default", overrides, flags)
    if saved is not None and "schedule.iterations" not in overrides:
        config = with_iterations_of(saved, config)
    user_fields = {*config.plan.keep, *(path for path in overrides if not path.startswith("plan."))}
    return override_config(config, {"plan.keep": sorted(user_fields)})


def next_commands(path: Path, summary: dict) -> str:
    """Return the lines that end a training: its result, and what to type next."""
    from .run_output import format_scores

    scores = [figures for line in summary["metrics"] if (figures := format_scores(line))]
    heldout = f", {scores[-1]}" if scores else ""
    result = f"{summary['iteration']} iterations, {summary['gaussians']} Gaussians{heldout}"
    run, views, report = (shlex.quote(str(place)) for place in (path, path / "views", path / "report"))
    cameras = "" if scores else " --cameras train"
    return f"""{path}: {result}, {summary["train_seconds"]:.1f} s on {summary["device"]}
look at it:         sehdr-warp view {run}
page to send:       sehdr-warp export {run} --out scene.html
exposure brackets:  sehdr-warp render {run} --out {views}{cameras} --evs=-4,-2,0,2,4
lamps and windows:  sehdr-warp lights {run}
pictures, splats:   sehdr-warp report {run} --out {report};  sehdr-warp export {run} --out scene.ply"""
