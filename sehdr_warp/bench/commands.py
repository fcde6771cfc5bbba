"""The command line of `sehdr-warp bench`: what may be asked for, and the call. torch is imported when it runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..arguments import numbers, positive, say
from .quality_command import Quality, run_quality
from .response_command import Responses, run_responses


@dataclass(frozen=True, kw_only=True)
class Output:
    """Where the figures go."""

    json: Path | None = None
    """Write the result to this file."""
    out: Path | None = None
    """Folder for the result as JSON and table, and for pictures."""
    overwrite: bool = False
    """Replace files that exist."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""


@dataclass(frozen=True, kw_only=True)
class Kernels(Output):
    """Time the whole differentiable splat, forward and backward, against peers and the plain torch reference."""

    channels: str = "3,9,15"
    """Feature channels, separated by commas."""
    sizes: str | None = None
    """small, medium, large or Gaussians@WIDTHxHEIGHT such as 20k@200x200, separated by commas."""
    peers: bool = False
    """Also time gsplat and gswarp, where they are installed and there is a GPU."""
    repetitions: int = 30
    """Timed runs of each variant; slow ones have fewer on the CPU."""
    budget: float = 20.0
    """Seconds that one variant may take on the CPU."""


@dataclass(frozen=True, kw_only=True)
class Step(Output):
    """Time a whole training step of a preset on a synthetic scene."""

    preset: str = "default"
    """default, paper, fast, demo, 3dgs, or a TOML file."""
    size: str | None = None
    """Gaussians@WIDTHxHEIGHT; by default 100k@400x400 on a GPU and 20k@200x200 on the CPU."""
    repetitions: int = 30
    """Timed steps."""
    budget: float = 20.0
    """Seconds that one variant may take on the CPU."""


@dataclass(frozen=True, kw_only=True)
class Training(Output):
    """Train plain 3DGS on our kernels and with gsplat on equal terms, and compare."""

    data: tyro.conf.Positional[str]
    """Photos, as for train."""
    iterations: int = 30_000
    """Training steps of both."""
    max_size: int | None = None
    """Longest side of the photos, in pixels; larger ones are reduced."""
    exposure_index: int | None = None
    """Which exposure to train on where a view has several; by default the middle one."""
    seed: int = 0
    """Seed of every random number."""
    released: bool = False
    """Also train gsplat as version 1.5.3 is released: without resets of the opacities."""


@dataclass(frozen=True, kw_only=True)
class Scale(Output):
    """Time and memory against Gaussians, pixels and channels, with the slope of each stage."""

    sweeps: str = "gaussians,pixels,channels"
    """What is varied, separated by commas."""
    peers: bool = False
    """Also measure gsplat at nine channels, where it is installed and there is a GPU."""
    no_steps: bool = False
    """Leave out whole training steps, which the sweeps over Gaussians and pixels have."""
    repetitions: int = 30
    """Timed runs of each variant; slow ones have fewer on the CPU."""
    budget: float = 3.0
    """Seconds that one variant may take on the CPU."""


@dataclass(frozen=True)
class Bench:
    """Measure speed: splats, training steps, trainings, growth with size, quality."""

    benchmark: (
        Annotated[Kernels, tyro.conf.subcommand("kernels")]
        | Annotated[Step, tyro.conf.subcommand("step")]
        | Annotated[Training, tyro.conf.subcommand("training")]
        | Annotated[Scale, tyro.conf.subcommand("scale")]
        | Annotated[Quality, tyro.conf.subcommand("quality")]
        | Annotated[Responses, tyro.conf.subcommand("response")]
    )


def run_bench(command: Bench) -> None:
    """Measures, prints the tables and writes what was asked for; raises SehdrError if a correctness check failed, after
    everything was written."""
    from ..training.train import pick_device
    from .checks import require
    from .report import check_writable, format_report, write_report

    asked = command.benchmark
    if isinstance(asked, Quality):
        run_quality(asked)
        return
    if isinstance(asked, Responses):
        run_responses(asked)
        return
    check_writable(type(asked).__name__.lower(), asked.json, asked.out, asked.overwrite)
    report = _MEASURES[type(asked)](asked, pick_device(asked.device))
    print(format_report(report))
    write_report(report, json=asked.json, out=asked.out, overwrite=asked.overwrite)
    require(report["checks"])


def _kernels(asked: Kernels, device) -> dict:
    from .kernels import bench_kernels
    from .splats import parse_sizes

    return bench_kernels(
        parse_sizes(asked.sizes, device.type),
        numbers("--channels", asked.channels, int, least=1),
        device,
        peers=asked.peers,
        repetitions=positive("--repetitions", asked.repetitions),
        budget=positive("--budget", asked.budget),
        progress=say,
    )


def _step(asked: Step, device) -> dict:
    from .splats import parse_size
    from .step import bench_step

    default = {"cuda": "100k@400x400", "cpu": "20k@200x200"}[device.type]
    return bench_step(
        parse_size(default if asked.size is None else asked.size, device.type),
        device,
        preset=asked.preset,
        repetitions=positive("--repetitions", asked.repetitions),
        budget=positive("--budget", asked.budget),
        progress=say,
    )


def _training(asked: Training, device) -> dict:
    from ..scene import load_scene
    from .training import bench_training

    scene = load_scene(asked.data, exposure_index=asked.exposure_index, max_size=asked.max_size)
    return bench_training(
        scene,
        device,
        iterations=positive("--iterations", asked.iterations),
        seed=asked.seed,
        released=asked.released,
        out=asked.out,
        overwrite=asked.overwrite,
        progress=say,
    )


def _scale(asked: Scale, device) -> dict:
    from .scale import bench_scale, parse_sweeps

    return bench_scale(
        parse_sweeps(asked.sweeps, device.type),
        device,
        peers=asked.peers,
        steps=not asked.no_steps,
        repetitions=positive("--repetitions", asked.repetitions),
        budget=positive("--budget", asked.budget),
        progress=say,
    )


_MEASURES = {Kernels: _kernels, Step: _step, Training: _training, Scale: _scale}
