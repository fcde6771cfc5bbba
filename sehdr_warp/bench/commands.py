"""The command line of `sehdr-warp bench`: what may be asked for, and the call. torch is imported when it runs."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..arguments import numbers, positive
from ..errors import InputError, SehdrError


@dataclass(frozen=True, kw_only=True)
class Output:
    """Where the result goes."""

    json: Path | None = None
    """Write the result to this file."""
    overwrite: bool = False
    """Replace files that exist."""


@dataclass(frozen=True, kw_only=True)
class Timed(Output):
    """How things are timed."""

    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    repetitions: int = 30
    """Timed runs of each variant; slow ones have fewer on the CPU."""
    budget: float = 10.0
    """Seconds that one variant may take on the CPU."""


@dataclass(frozen=True, kw_only=True)
class Kernels(Timed):
    """Time the whole differentiable splat, forward and backward, against peers and the plain torch reference."""

    channels: str = "3,9,15"
    """Feature channels, separated by commas."""
    sizes: str | None = None
    """Gaussians@WIDTHxHEIGHT such as 20k@200x200, separated by commas."""
    peers: bool = False
    """Also time gsplat, where it is installed and there is a GPU."""


@dataclass(frozen=True, kw_only=True)
class Step(Timed):
    """Time a whole training step of presets on a synthetic scene, recorded and launched."""

    preset: str = "default"
    """Presets or TOML files, separated by commas."""
    size: str | None = None
    """Gaussians@WIDTHxHEIGHT; by default 100k@400x400 on a GPU and 20k@200x200 on the CPU."""


@dataclass(frozen=True, kw_only=True)
class Scale(Timed):
    """Time and memory of splats and training steps over what grows, with slopes."""

    sweeps: str = "gaussians,pixels,channels,photos"
    """What is varied, separated by commas."""
    peers: bool = False
    """Also measure gsplat, and the same step on its rasterizer, where it is installed and there is a GPU."""
    small: bool = False
    """Every second point, without the largest."""


@dataclass(frozen=True, kw_only=True)
class Training(Output):
    """Train plain 3DGS on our kernels and with gsplat on equal terms, and compare."""

    data: tyro.conf.Positional[str]
    """Photos, as for train."""
    iterations: int = 30_000
    """Training steps of both."""
    max_size: int | None = None
    """Longest side of the photos, in pixels; larger ones are reduced."""
    seed: int = 0
    """Seed of every random number."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""


@dataclass(frozen=True, kw_only=True)
class Quality(Output):
    """Train methods on scenes with HDR truth and compare; finished trainings in --out never run again."""

    out: Path
    """Folder of the jobs and their results."""
    scenes: str = "embedded"
    """Folders with HDR truth in all views, embedded or embedded:NAME, separated by commas."""
    methods: str = "default,paper,hdr-gs,3dgs,truth"
    """Presets or TOML files, separated by commas; empty for variants alone."""
    variant: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A method with other values, NAME:BASE:field=value,field=value, such as no-clip:default:loss.clipping=false; may
    be given several times."""
    curves: str = "hdr-nerf"
    """Camera responses that expose the truth: names or files, separated by commas."""
    exposures: str = "2"
    """Out of a ladder of five, 0 to 4, separated by commas; every training has one."""
    responses: str = "known"
    """known (the method is told the curve), blind (it is not), or both, separated by a comma."""
    seeds: str = "0"
    """Seeds of the trainings, separated by commas."""
    iterations: int | None = None
    """Training steps; by default each preset's own."""
    max_size: int | None = None
    """Longest side of the views, in pixels."""
    lpips: Path | None = None
    """Folder with LPIPS weights, by default that of SEHDR_LPIPS; LPIPS is null without."""
    flip: bool = False
    """Also HDR-FLIP (pip install sehdr-warp[flip])."""
    device: str | None = None
    """cpu or cuda; by default cuda if there is a GPU."""
    jobs: int = 1
    """Trainings at one time, spread over the GPUs; more than one needs submitit."""
    slurm: str | None = None
    """Submit to SLURM, with these parameters, such as partition=gpu,time=240 (minutes)."""


@dataclass(frozen=True, kw_only=True)
class Responses(Output):
    """How well the camera's response is found from photos alone, on scenes with HDR truth."""

    data: tyro.conf.Positional[tuple[str, ...]] = ("embedded",)
    """Scenes with HDR truth."""
    curves: str | None = None
    """Responses that expose the scenes, separated by commas; by default HDR-NeRF's, four encodings, two film curves."""
    exposures: int = 5
    """Exposures of each scene, each four times longer than the last."""
    max_size: int | None = None
    """Longest side of the scenes' photos, in pixels."""
    seed: int = 0
    """Seed of what the choice draws."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write the tables and plots of docs/reports from the results in it."""

    folder: tyro.conf.Positional[Path] = Path("docs/reports")
    """Folder with results/*.json and tried.csv."""


@dataclass(frozen=True)
class Bench:
    """Measure speed, memory and quality, and write the reports."""

    benchmark: (
        Annotated[Kernels, tyro.conf.subcommand("kernels")]
        | Annotated[Step, tyro.conf.subcommand("step")]
        | Annotated[Scale, tyro.conf.subcommand("scale")]
        | Annotated[Training, tyro.conf.subcommand("training")]
        | Annotated[Quality, tyro.conf.subcommand("quality")]
        | Annotated[Responses, tyro.conf.subcommand("response")]
        | Annotated[Report, tyro.conf.subcommand("report")]
    )


def run_bench(command: Bench) -> None:
    """Measures, prints the table and writes the result; raises SehdrError if a check failed, after everything is
    written."""
    from ..files import check_absent
    from .results import finish

    asked = command.benchmark
    if isinstance(asked, Report):
        from .report import write_reports

        for path in write_reports(asked.folder):
            print(path)
        return
    if asked.json is not None:
        check_absent(asked.json, asked.overwrite)
    result, columns = _MEASURES[type(asked)](asked)
    finish(result, asked.json, asked.overwrite, columns)


def _timed(asked: Timed) -> dict:
    repetitions, budget = positive("--repetitions", asked.repetitions), positive("--budget", asked.budget)
    return {"repetitions": repetitions, "budget": budget}


def _kernels(asked: Kernels):
    from ..training.train import pick_device
    from .kernels import COLUMNS, bench_kernels
    from .splats import parse_size

    device = pick_device(asked.device)
    default = {"cuda": "50k@400x400,200k@800x800,1M@1600x1200", "cpu": "5k@200x200,20k@200x200"}[device.type]
    sizes = [parse_size(item) for item in (asked.sizes or default).split(",")]
    channels = numbers("--channels", asked.channels, int, least=1)
    return bench_kernels(sizes, channels, device, peers=asked.peers, **_timed(asked)), COLUMNS


def _step(asked: Step):
    from ..training.train import pick_device
    from .splats import parse_size
    from .step import COLUMNS, bench_step

    device = pick_device(asked.device)
    size = parse_size(asked.size or {"cuda": "100k@400x400", "cpu": "20k@200x200"}[device.type])
    return bench_step(size, device, presets=_words(asked.preset), **_timed(asked)), COLUMNS


def _scale(asked: Scale):
    from ..training.train import pick_device
    from .scale import COLUMNS, bench_scale

    device, names = pick_device(asked.device), _words(asked.sweeps)
    return bench_scale(names, device, peers=asked.peers, small=asked.small, **_timed(asked)), COLUMNS


def _training(asked: Training):
    from ..scene import load_scene
    from ..training.train import pick_device
    from .training import COLUMNS, bench_training

    device, iterations = pick_device(asked.device), positive("--iterations", asked.iterations)
    scene = load_scene(asked.data, max_size=asked.max_size)
    return bench_training(scene, device, iterations=iterations, seed=asked.seed), COLUMNS


def _quality(asked: Quality):
    import torch

    from .jobs import choose_methods, plan_jobs
    from .quality import COLUMNS, run_jobs
    from .results import new_result

    device = asked.device or ("cuda" if torch.cuda.is_available() else "cpu")
    if device not in ("cpu", "cuda"):
        raise SehdrError(f"--device {device}: not cpu or cuda; choose among GPUs with CUDA_VISIBLE_DEVICES")
    lpips = asked.lpips or os.environ.get("SEHDR_LPIPS") or None
    jobs = plan_jobs(
        _words(asked.scenes),
        choose_methods(_words(asked.methods), asked.variant),
        curves=_words(asked.curves),
        exposures=numbers("--exposures", asked.exposures, int, least=0),
        responses=_words(asked.responses),
        seeds=numbers("--seeds", asked.seeds, int, least=0),
        iterations=None if asked.iterations is None else positive("--iterations", asked.iterations),
        max_size=asked.max_size,
        device=device,
        judged_by=["lpips"] * (lpips is not None) + ["flip"] * asked.flip,
    )
    at_once = positive("--jobs", asked.jobs)
    weights = None if lpips is None else str(Path(lpips).absolute())
    rows = run_jobs(jobs, asked.out, device=device, at_once=at_once, slurm=_pairs(asked.slurm), lpips=weights)
    result = new_result("quality", torch.device(device), {"jobs": asked.jobs})
    result["rows"] = [row for row in rows if "error" not in row]
    for row in rows:
        what = row.get("label") or f"{row['scene']} {row['method']}"
        result["checks"].append({"what": what, "passed": "error" not in row, "error": row.get("error")})
    return result, COLUMNS


def _responses(asked: Responses):
    from .response import COLUMNS, CURVES, bench_response

    curves = CURVES if asked.curves is None else _words(asked.curves)
    exposures = positive("--exposures", asked.exposures)
    return bench_response(asked.data, curves, exposures=exposures, max_size=asked.max_size, seed=asked.seed), COLUMNS


_MEASURES = {
    Kernels: _kernels,
    Step: _step,
    Scale: _scale,
    Training: _training,
    Quality: _quality,
    Responses: _responses,
}


def _words(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(item.strip() for item in text.split(",") if item.strip()))


def _pairs(text: str | None) -> dict[str, str] | None:
    if text is None:
        return None
    pairs = [item.partition("=") for item in _words(text)]
    if not all(name and equals for name, equals, _ in pairs):
        raise InputError(f"--slurm {text}", "not name=value pairs", "write for example --slurm partition=gpu")
    return {name: value for name, _, value in pairs}
