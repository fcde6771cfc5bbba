"""The command line of `sehdr-warp bench quality`. torch is imported by the workers, not here."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..arguments import numbers, positive, say
from ..errors import InputError, SehdrError


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Train methods on scenes with HDR truth at several exposures, and compare: every training a job that resumes."""

    out: Path
    """Folder for jobs, results, tables and plots; finished jobs in it never run again."""
    scenes: str = "embedded"
    """Folders with HDR truth in all views, embedded or embedded:NAME, separated by commas."""
    methods: str = "default,paper,hdr-gs,3dgs,truth"
    """default, paper, paper-truth, hdr-gs, hdr-gs-truth, gauss-hdr, 3dgs, predicted, truth, other presets or
    TOML files, separated by commas; empty for variants alone."""
    variant: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A method with other values, NAME:BASE:field=value,field=value, such as no-clip:default:loss.clipping=false; may
    be given several times."""
    variants: Path | None = None
    """TOML file with a table for each variant: base and the fields that differ."""
    curves: str = "hdr-nerf"
    """Camera responses that expose the truth: names or files, separated by commas."""
    exposures: str = "0,1,2,3,4"
    """Which of the exposures, separated by commas; every job has one."""
    exposure_count: int = 5
    """Exposures in a scene's ladder; the middle one is well exposed."""
    exposure_factor: float = 4.0
    """How many times longer each is than the last."""
    responses: str = "known"
    """known (the method is told the curve), blind (it is not), or both, separated by a comma."""
    seeds: str = "0"
    """Seeds of the trainings, separated by commas."""
    iterations: str | None = None
    """Training steps, one or more numbers separated by commas; by default each preset's own."""
    max_size: int | None = None
    """Longest side of the views, in pixels."""
    noise: str | None = None
    """Sensor noise in the training photos: electrons of a full well, and of read noise, such as 20000,5."""
    predictor: str | None = None
    """For the method predicted: what makes HDR of a single photo, a name, a folder or a network; {scene} and {exposure}
    in it stand for the job's."""
    lpips: Path | None = None
    """Folder with LPIPS weights; by default that of SEHDR_LPIPS, and LPIPS is null without."""
    flip: bool = False
    """Also HDR-FLIP (pip install sehdr-warp[flip])."""
    device: str | None = None
    """cpu or cuda; by default cuda if there is a GPU."""
    gpus: str | None = None
    """Numbers of the GPUs to use, separated by commas; by default all."""
    workers: int | None = None
    """Trainings at one time; by default one for each GPU. Several may share a GPU, which their seconds show."""
    launcher: str = "auto"
    """auto: submitit (SLURM where there is one, else local processes), or plain processes without it; or slurm, local,
    process."""
    slurm: str | None = None
    """Parameters of SLURM jobs, such as partition=gpu,time=240 (minutes)."""
    keep_runs: bool = False
    """Keep the trained models in their job folders."""
    report_only: bool = False
    """Run nothing: make results, tables and plots again from the job folders."""
    report_scenes: str | None = None
    """With --report-only: tables of these scenes alone, names separated by commas, written as quality-NAMES.md."""


def run_quality(asked: Quality) -> None:
    """Plans, runs, reports; raises SehdrError if a job failed, after everything was written."""
    from .quality_report import write_quality_report, write_scenes_report

    if asked.report_scenes is not None and not (asked.report_only and _words(asked.report_scenes)):
        raise SehdrError(f"--report-scenes {asked.report_scenes}: needs --report-only and names of scenes")
    if asked.report_only:
        if not (asked.out / "jobs").is_dir():
            raise InputError(asked.out, "holds no jobs", "give the --out of an earlier `bench quality`")
        scenes = _words(asked.report_scenes or "")
        print(write_scenes_report(asked.out, scenes) if scenes else write_quality_report(asked.out))
        return
    from .methods import choose_methods
    from .quality import bench_quality
    from .quality_jobs import Settings
    from .quality_pool import LAUNCHERS, Workers

    if asked.launcher not in LAUNCHERS:
        raise SehdrError(f"--launcher {asked.launcher}: not one of {', '.join(LAUNCHERS)}")
    device, gpus = _devices(asked)
    lpips = asked.lpips or (os.environ.get("SEHDR_LPIPS") or None)
    settings = Settings(
        scenes=_words(asked.scenes),
        methods=tuple(choose_methods(_words(asked.methods), asked.variant, asked.variants)),
        curves=_words(asked.curves),
        exposures=_whole("--exposures", asked.exposures),
        responses=_words(asked.responses),
        seeds=_whole("--seeds", asked.seeds),
        iterations=(None,) if asked.iterations is None else _whole("--iterations", asked.iterations),
        max_size=asked.max_size,
        exposure_count=asked.exposure_count,
        exposure_factor=asked.exposure_factor,
        noise=_noise(asked.noise),
        predictor=asked.predictor,
        lpips=lpips is not None,
        flip=asked.flip,
        device=device,
    )
    workers = Workers(
        count=len(gpus) or 1 if asked.workers is None else positive("--workers", asked.workers),
        gpus=gpus,
        lpips=None if lpips is None else str(Path(lpips).absolute()),
        keep_runs=asked.keep_runs,
        slurm=_pairs(asked.slurm),
        launcher=asked.launcher,
    )
    text, failure = bench_quality(settings, asked.out, workers, progress=say)
    print(text)
    if failure is not None:
        raise failure


def _devices(asked: Quality) -> tuple[str, tuple[int, ...]]:
    """The kind of device, and the numbers of the GPUs."""
    if asked.device not in (None, "cpu", "cuda"):
        raise SehdrError(f"--device {asked.device}: not cpu or cuda; choose among GPUs with --gpus")
    if asked.device == "cpu":
        if asked.gpus is not None:
            raise InputError(f"--gpus {asked.gpus}", "there are none with --device cpu", "leave one of the two out")
        return "cpu", ()
    import torch

    there = torch.cuda.device_count()
    if not there and (asked.device == "cuda" or asked.gpus is not None):
        raise SehdrError("torch sees no GPU here; use --device cpu")
    gpus = tuple(range(there)) if asked.gpus is None else _whole("--gpus", asked.gpus)
    for gpu in gpus:
        if gpu >= there:
            raise InputError(f"--gpus {asked.gpus}", f"torch sees {there} GPU(s)", "give some of them, numbered from 0")
    return ("cuda", gpus) if there else ("cpu", ())


def _words(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(item.strip() for item in text.split(",") if item.strip()))


def _whole(flag: str, text: str) -> tuple[int, ...]:
    return tuple(dict.fromkeys(numbers(flag, text, int, least=0)))


def _noise(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    from ..synth.expose import SensorNoise

    try:
        noise = SensorNoise(*(float(item) for item in text.split(",")))
    except (TypeError, ValueError):
        raise InputError(
            f"--noise {text}", "not one or two numbers of electrons", "write for example --noise 20000,5"
        ) from None
    return noise.full_well, noise.read_noise


def _pairs(text: str | None) -> dict[str, str]:
    pairs = [item.partition("=") for item in _words(text or "")]
    if not all(name and equals for name, equals, _ in pairs):
        raise InputError(
            f"--slurm {text}", "not name=value pairs separated by commas", "write for example --slurm partition=gpu"
        )
    return {name: value for name, _, value in pairs}
