"""`bench quality`: every job trained and evaluated once, several at a time, and their results as rows."""

import contextlib
import logging
import shutil
import traceback
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import cycle
from pathlib import Path

import torch
from filelock import FileLock, Timeout

from ..errors import InputError, SehdrError
from ..evaluation.evaluate import evaluate
from ..files import write_json
from ..response import response_by_name
from ..scene import Scene, load_scene
from ..synth.expose import expose, exposure_ladder
from ..training.config import Config
from ..training.config_files import config_from_dict, override_config
from ..training.train import train
from .jobs import EXPOSURES, FACTOR, FAILURE, FORMAT, RESULT, Job, read_json
from .timing import Variant, forget_peaks, time_variants

LOG = logging.getLogger(__name__)
WARM_UP_ITERATIONS = 30
"""Of a training that is thrown away before the first of its kind in a process: kernels are compiled, steps recorded.
All schedules scale with the length, so every part of a training is in it."""
_warm: set[str] = set()


def run_jobs(
    jobs: Sequence[Job],
    out: Path,
    *,
    device: str,
    at_once: int = 1,
    slurm: dict | None = None,
    lpips: str | None = None,
) -> list[dict]:
    """Runs the jobs that have no result in out/jobs, and returns a row for each job of the list: its result, or its
    label and error.

    device: kind, "cpu" or "cuda". at_once: trainings at one time; more than one, or any on SLURM, by submitit. slurm:
    parameters of SLURM jobs such as {"partition": "gpu"}, None for this machine. lpips: folder of weights.
    """
    open_jobs = [job for job in jobs if job.result(out) is None]
    LOG.info("%d jobs, %d of them to do", len(jobs), len(open_jobs))
    for job in open_jobs:
        (job.folder(out) / FAILURE).unlink(missing_ok=True)
    at_once = max(1, min(at_once, len(open_jobs)))
    if open_jobs and at_once == 1 and slurm is None:
        work(open_jobs, out, device, 1, lpips)
    elif open_jobs:
        _submit(open_jobs, out, device, at_once, slurm, lpips)
    rows = []
    for job in jobs:
        result, failure = job.result(out), read_json(job.folder(out) / FAILURE) or {}
        error = failure.get("error", "no worker was left to run it")
        rows.append(row_of(result) if result else {"label": job.label, "error": error})
    return rows


def row_of(result: dict) -> dict:
    """A result as one flat row: what was trained, its figures, and its held-out tests as [seconds, dB]."""
    config, figures = result["config"], result["figures"]
    hdr, regions = figures["protocol"], figures["regions"]
    names = ("curve", "exposure", "method", "sees_truth", "response", "seed", "device")
    return {
        "scene": config["scene"]["name"],
        **{name: config[name] for name in names},
        **{name: figures[name] for name in ("iterations", "gaussians", "peak_memory_bytes", "renders_per_second")},
        "gt_max": hdr["gt-max"]["psnr_mu"],
        "self_max": hdr["self-max"]["psnr_mu"],
        "aligned": hdr["aligned"]["psnr_mu"],
        "ssim": hdr["gt-max"]["ssim_mu"],
        "lpips": hdr["gt-max"]["lpips_mu"],
        "ldr": figures["ldr"]["psnr"],
        "clipped": regions["clipped"]["psnr_mu"]["aligned"],
        "well_exposed": regions["well-exposed"]["psnr_mu"]["aligned"],
        "dark": regions["dark"]["psnr_mu"]["aligned"],
        "clipped_share": regions["clipped"]["fraction"],
        "confidence": figures["confidence"]["spearman_log2"],
        "chosen": figures["response"],
        "seconds": figures["train_seconds"],
        "shared_by": result["shared_by"],
        "tests": [[line["seconds"], line["psnr_mu"]] for line in result["curve"] if line.get("psnr_mu") is not None],
    }


def _submit(jobs, out: Path, device: str, at_once: int, slurm: dict | None, lpips: str | None) -> None:
    """Workers by submitit, each taking job after job; returns when all have ended."""
    try:
        import submitit
    except ImportError:
        problem = "submitit starts several jobs at once and is not installed"
        raise SehdrError(f"{problem}; pip install 'sehdr-warp[slurm]', or take --jobs 1") from None
    gpus = torch.cuda.device_count() if device == "cuda" and slurm is None else 0
    shared = -(-at_once // gpus) if gpus else at_once if slurm is None else 1
    workers = []
    for index in range(at_once):
        executor = submitit.AutoExecutor(folder=out / "logs", cluster="local" if slurm is None else "slurm")
        executor.update_parameters(timeout_min=30 * 24 * 60, name="sehdr-warp")
        if gpus:
            executor.update_parameters(gpus_per_node=1, visible_gpus=[index % gpus])
        elif slurm is not None:
            one = {"gpus_per_node": 1} if device == "cuda" else {}
            own = {key if key == "timeout_min" else f"slurm_{key}": value for key, value in slurm.items()}
            executor.update_parameters(**one, **own)
        workers.append(executor.submit(work, jobs, out.absolute(), device, shared, lpips))
    try:
        for worker in workers:
            worker.wait()
            if error := worker.exception():
                LOG.warning("a worker ended early: %s", str(error).strip().splitlines()[-1])
    except BaseException:
        for worker in workers:
            worker.cancel()
        raise


def work(jobs: Sequence[Job], out: Path, device: str, shared_by: int, lpips: str | None) -> None:
    """A worker: takes the jobs that nobody is at, one after the other. Whoever holds the lock of a job's folder is at
    it; the operating system lets go of it when a worker dies, however it dies."""
    for job in jobs:
        folder = job.folder(out)
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(Timeout), FileLock(folder / "lock", timeout=0):
            if job.result(out) is not None or (folder / FAILURE).exists():
                continue
            # Stays if this process is killed: then no other worker tries, and dies, again.
            _write_failure(folder, "its process ended without a result")
            try:
                result = run_job(job, folder, "cuda:0" if device == "cuda" else device, lpips)
                write_json(folder / RESULT, result | {"shared_by": shared_by}, overwrite=True)
                (folder / FAILURE).unlink()
                LOG.info("%s: done", job.label)
            except SehdrError as error:
                _write_failure(folder, str(error))
            except Exception as error:
                traceback.print_exc()
                _write_failure(folder, f"{type(error).__name__}: {error}")
                if device == "cuda":
                    raise  # the device may be spoilt for this process; other workers go on


def _write_failure(folder: Path, error: str) -> None:
    write_json(folder / FAILURE, {"error": " ".join(error.split())[:1000]}, overwrite=True)


def run_job(job: Job, folder: Path, device: str, lpips: str | None) -> dict:
    """Trains, evaluates and returns the result as it is to be written. Scenes, photos and kernels stay for the next.

    Raises SehdrError where the scene has no truth, the training diverges, or a file cannot be used.
    """
    config, out = job.config, folder / "run"
    scene = exposed(job.place, config["scene"]["max_size"], config["curve"], config["exposure"])
    training = config_from_dict(config["training"], job.label)
    # A method that learns from photos alone sees no truth in the training views.
    views = tuple(replace(view, hdr=None) if view.split == "train" else view for view in scene.views)
    shown = scene if config["sees_truth"] else replace(scene, views=views)
    _warm_up(shown, training, folder / "warm-up", device)
    shutil.rmtree(out, ignore_errors=True)
    forget_peaks(torch.device(device))
    run = train(shown, out, training, device=device)
    peak = torch.cuda.max_memory_allocated(device) if device.startswith("cuda") else None
    figures = evaluate(run, scene, lpips_weights=lpips if config["lpips"] else None)
    figures.pop("views")
    figures |= {"response": run.response.name, "peak_memory_bytes": peak}
    figures["renders_per_second"] = _render_rate(run, scene)
    curve = run.metrics()
    shutil.rmtree(out, ignore_errors=True)
    return {"format": FORMAT, "key": job.key, "config": config, "figures": figures, "curve": curve}


def _warm_up(scene: Scene, config: Config, scratch: Path, device: str) -> None:
    # What is compiled depends on the shape of the computation, not on seeds, rates or lengths.
    shape = repr((config.model, config.response.name == "learned", config.fusion, config.densification.strategy))
    if shape not in _warm:
        short = override_config(config, {"schedule.iterations": WARM_UP_ITERATIONS, "plan.enabled": False})
        shutil.rmtree(scratch, ignore_errors=True)
        train(scene, scratch, short, device=device)
        shutil.rmtree(scratch, ignore_errors=True)
        _warm.add(shape)


@torch.no_grad()
def _render_rate(run, scene: Scene) -> float:
    """HDR renders of held-out views per second, called one after the other."""
    cameras = cycle([view.camera for view in scene.test_views or scene.train_views])
    variant = Variant(lambda: run.render(next(cameras)))
    return 1e3 / time_variants({"render": variant}, run.device, budget=1.0)["render"]["mean_ms"]


@lru_cache(maxsize=8)
def exposed(place: str, max_size: int | None, curve: str, exposure: int) -> Scene:
    """A scene with its truth, as a job's camera took it: by a curve, at a place in the ladder of exposures."""
    truth, response = _true_scene(place, max_size), response_by_name(curve)
    return expose(truth, response, exposure_ladder(truth, response, EXPOSURES, FACTOR)[exposure])


@lru_cache(maxsize=4)
def _true_scene(place: str, max_size: int | None) -> Scene:
    scene = load_scene(place, max_size=max_size, response="srgb")
    for view in (view for view in scene.views if view.hdr is None):
        problem = f"view {view.name} has no HDR truth"
        raise InputError(place, problem, "only scenes with truth in every view can be benchmarked")
    return scene
