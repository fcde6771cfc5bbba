"""The commands of `python -m benchmarks`. torch is imported when they run."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from sehdr_warp.arguments import parse_numbers, parse_pairs
from sehdr_warp.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Output:
    """Options of the result."""

    json: Path | None = None
    """Write the result to this file."""
    overwrite: bool = False
    """Replace files that exist."""

    def report(self, result: dict) -> None:
        """Print the result; raise SehdrError if a check failed."""
        from .results import finish

        finish(result)


@dataclass(frozen=True, kw_only=True)
class Timed(Output):
    """Options of timing."""

    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    repetitions: int = 30
    """Timed runs of each variant; slow ones have fewer on the CPU."""

    def timing(self) -> dict:
        """Return the device and the number of repetitions."""
        from sehdr_warp.runs.device import pick_device

        return {"device": pick_device(self.device), "repetitions": require_positive("--repetitions", self.repetitions)}


@dataclass(frozen=True, kw_only=True)
class Kernels(Timed):
    """Time the whole differentiable splat, forward and backward, beside plain torch or, if it is installed, gsplat."""

    channels: str = "3,9,15"
    """Feature channels, separated by commas."""
    sizes: str | None = None
    """Gaussians@WIDTHxHEIGHT such as 20k@200x200, separated by commas."""

    def measure(self):
        """Run the benchmark and return its result."""
        from .kernels import bench_kernels

        timing = self.timing()
        default = {"cuda": "50k@400x400,200k@800x800,1M@1600x1200", "cpu": "5k@200x200,20k@200x200"}
        sizes = _sizes(self.sizes or default[timing["device"].type])
        return bench_kernels(sizes, parse_numbers("--channels", self.channels, int, minimum=1), **timing)


@dataclass(frozen=True, kw_only=True)
class Step(Timed):
    """Time a whole training step of presets on a synthetic scene, recorded and launched."""

    preset: str = "default"
    """Presets or TOML files, separated by commas."""
    size: str | None = None
    """Gaussians@WIDTHxHEIGHT; by default 100k@400x400 on a GPU and 20k@200x200 on the CPU."""

    def measure(self):
        """Run the benchmark and return its result."""
        from .splats import parse_size
        from .step import bench_step

        timing = self.timing()
        size = parse_size(self.size or {"cuda": "100k@400x400", "cpu": "20k@200x200"}[timing["device"].type])
        return bench_step(size, presets=_words(self.preset), **timing)


@dataclass(frozen=True, kw_only=True)
class Workers(Timed):
    """Time training steps on more and more threads of the CPU, or on more and more GPUs."""

    sizes: str | None = None
    """Gaussians@WIDTHxHEIGHT, separated by commas; by default 1M@1600x1200 on GPUs, 20k@200x200 and 100k@800x800 on the
    CPU."""

    def measure(self):
        """Run the benchmark and return its result."""
        from .workers import bench_workers

        timing = self.timing()
        default = {"cuda": "1M@1600x1200", "cpu": "20k@200x200,100k@800x800"}
        return bench_workers(_sizes(self.sizes or default[timing["device"].type]), **timing)


@dataclass(frozen=True, kw_only=True)
class Quality(Output):
    """Train methods on scenes with HDR truth and compare; finished trainings in --out never run again.

    LPIPS is measured if SEHDR_LPIPS names a folder with its weights.
    """

    out: Path
    """Folder of the jobs and their results."""
    scenes: str = "embedded"
    """Folders with HDR truth in all views, embedded or embedded:NAME, separated by commas."""
    methods: str = "default,paper,hdr-gs,3dgs,truth"
    """Presets or TOML files, separated by commas."""
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
    device: Literal["cpu", "cuda"] | None = None
    """By default cuda if there is a GPU; CUDA_VISIBLE_DEVICES chooses among several."""
    jobs: int = 1
    """Trainings at one time, spread over the GPUs; more than one needs submitit."""
    slurm: str | None = None
    """Submit to SLURM, with these parameters, such as partition=gpu,time=240 (minutes; a day by default)."""

    def measure(self):
        """Run the benchmark and return its result."""
        import torch

        from .quality import plan_jobs, run_jobs
        from .results import new_result

        device = self.device or ("cuda" if torch.cuda.is_available() else "cpu")
        lpips = os.environ.get("SEHDR_LPIPS") or None
        options: dict[str, Any] = {
            name: _words(getattr(self, name)) for name in ("scenes", "methods", "curves", "responses")
        }
        for name in ("exposures", "seeds"):
            options[name] = tuple(dict.fromkeys(parse_numbers(f"--{name}", getattr(self, name), int, minimum=0)))
        iterations = self.iterations and require_positive("--iterations", self.iterations)
        jobs = plan_jobs(
            **options, iterations=iterations, max_size=self.max_size, device=device, lpips=lpips is not None
        )
        how = {"at_once": require_positive("--jobs", self.jobs), "slurm": parse_pairs("--slurm", self.slurm)}
        rows = run_jobs(jobs, self.out, device=device, lpips=lpips and os.path.abspath(lpips), **how)
        result = new_result("quality", torch.device(device), {"jobs": self.jobs})
        result["rows"] = [row for row in rows if "error" not in row]
        for job, row in zip(jobs, rows, strict=True):
            error = row.get("error")
            result["checks"].append({"what": job.label, "passed": error is None, "error": error})
        return result


@dataclass(frozen=True, kw_only=True)
class Responses(Output):
    """Measure how well the camera's response is chosen from photos alone, on scenes with HDR truth."""

    data: tyro.conf.Positional[tuple[str, ...]] = ("embedded",)
    """Scenes with HDR truth."""
    curves: str = "hdr-nerf,srgb,gamma-2.2,rec709,filmic,aces,camera"
    """Responses that expose the scenes, separated by commas."""
    exposures: int = 5
    """Exposures of each scene, each four times longer than the last."""
    max_size: int | None = None
    """Longest side of the scenes' photos, in pixels."""

    def measure(self):
        """Run the benchmark and return its result."""
        from .response import bench_response

        exposures = require_positive("--exposures", self.exposures)
        return bench_response(self.data, _words(self.curves), exposures=exposures, max_size=self.max_size)


@dataclass(frozen=True, kw_only=True)
class Stability(Output):
    """Stiff and extreme cases of splats, light and training against float64, each with its bound."""

    cases: str | None = None
    """Cases or groups (splat, light, poison, training), separated by commas; by default all."""
    quick: bool = False
    """Leave out the cases that take seconds."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""

    def measure(self):
        """Measure the cases and print each bound; checks are the cases."""
        from sehdr_warp.check.commands import run_cases
        from sehdr_warp.runs.device import pick_device

        from .results import new_result
        from .stability.catalogue import choose_cases

        device, cases = pick_device(self.device), choose_cases(self.cases, self.quick)
        return new_result("stability", device, {"device": str(device)}) | {"rows": run_cases(cases, device)}

    def report(self, result: dict) -> None:
        """Raise SehdrError if a case exceeds its bound."""
        from sehdr_warp.check.commands import require_bounds

        require_bounds(result["rows"], result["settings"]["device"])


@dataclass(frozen=True)
class Benchmarks:
    """Measure speed, memory, quality and stability."""

    benchmark: (
        Annotated[Kernels, tyro.conf.subcommand("kernels")]
        | Annotated[Step, tyro.conf.subcommand("step")]
        | Annotated[Workers, tyro.conf.subcommand("workers")]
        | Annotated[Quality, tyro.conf.subcommand("quality")]
        | Annotated[Responses, tyro.conf.subcommand("response")]
        | Annotated[Stability, tyro.conf.subcommand("stability")]
    )


def run_benchmark(options: Benchmarks) -> None:
    """Measure, write and print; raise SehdrError, after everything is written, if a check failed."""
    from sehdr_warp.files import check_absent, write_json

    benchmark = options.benchmark
    if benchmark.json is not None:
        check_absent(benchmark.json, benchmark.overwrite)
    result = benchmark.measure()
    if benchmark.json is not None:
        write_json(benchmark.json, result, benchmark.overwrite)
    benchmark.report(result)


def require_positive(flag: str, value: int) -> int:
    """Return the value of a flag; raise InputError if it is not above 0."""
    if not value > 0:
        raise InputError(f"{flag} {value}", "not positive", "give a number above 0")
    return value


def _sizes(text: str) -> list:
    from .splats import parse_size

    return [parse_size(item) for item in text.split(",")]


def _words(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(item.strip() for item in text.split(",") if item.strip()))
