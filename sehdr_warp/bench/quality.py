"""`bench quality`: every job trained and evaluated once, several at a time, and their results as rows."""

import contextlib
import gc
import logging
import secrets
import shutil
import time
import traceback
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import InputError, SehdrError
from ..files import write_json
from ..scene import Scene, load_scene
from .jobs import EXPOSURES, FACTOR, FAILURE, FORMAT, RESULT, Job, read_failure, read_result, write_failure

LOG = logging.getLogger(__name__)
WARM_UP_ITERATIONS = 30
"""Of a training that is thrown away before the first of its kind in a process: kernels are compiled and loaded, on a
GPU steps are recorded. All schedules scale with the length, so every part of a training is in it."""
NEAR_FINAL = 0.1
"""dB below the final held-out figure that count as reaching it."""
RENDER_SECONDS, RENDERS = 1.0, 100
"""A render is timed for so long or so often, whichever ends first."""
LONGEST_DAYS = 30
COLUMNS = {
    "scene": "", "curve": "", "exposure": "d", "method": "", "response": "", "seed": "d", "gt-max dB=gt_max": ".2f",
    "aligned dB=aligned": ".2f", "SSIM=ssim": ".4f", "LDR dB=ldr": ".2f", "clipped=clipped": ".2f",
    "well-exposed=well_exposed": ".2f", "seconds": ".1f", "MiB=peak_memory_bytes": "MiB", "Gaussians=gaussians": ",d",
    "error": "",
}  # fmt: skip


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

    Args:
        device: kind, "cpu" or "cuda". at_once: trainings at one time; more than one, or any on SLURM, by submitit.
        slurm: parameters of SLURM jobs such as {"partition": "gpu"}, None for this machine.
        lpips: folder of weights.
    """
    run = secrets.token_hex(8)
    open_jobs = [job for job in jobs if read_result(job.folder(out)) is None]
    LOG.info("%d jobs, %d of them to do", len(jobs), len(open_jobs))
    at_once = max(1, min(at_once, len(open_jobs)))
    if open_jobs and at_once == 1 and slurm is None:
        work(open_jobs, out, run, device, 1, lpips)
    elif open_jobs:
        _submit(open_jobs, out, run, device, at_once, slurm, lpips)
    rows = []
    for job in jobs:
        result, failure = read_result(job.folder(out)), read_failure(job.folder(out))
        lost = {"label": job.label, "error": failure["error"] if failure else "no worker was left to run it"}
        rows.append(row_of(result) if result else lost)
    return rows


def row_of(result: dict) -> dict:
    """A result as one flat row: what was trained, its figures, and its held-out tests as [seconds, dB]."""
    config, figures = result["config"], result["figures"]
    hdr, regions = figures["protocol"], figures["regions"]
    names = ("curve", "exposure", "method", "preset", "overrides", "sees_truth", "response", "seed", "device")
    return {
        "scene": config["scene"]["name"],
        **{name: config[name] for name in names},
        "iterations": figures["iterations"],
        "gt_max": hdr["gt-max"]["psnr_mu"],
        "self_max": hdr["self-max"]["psnr_mu"],
        "aligned": hdr["aligned"]["psnr_mu"],
        "ssim": hdr["gt-max"]["ssim_mu"],
        "lpips": hdr["gt-max"]["lpips_mu"],
        "flip": hdr["gt-max"].get("hdr_flip"),
        "ldr": figures["ldr"]["psnr"],
        "clipped": regions["clipped"]["psnr_mu"]["aligned"],
        "well_exposed": regions["well-exposed"]["psnr_mu"]["aligned"],
        "dark": regions["dark"]["psnr_mu"]["aligned"],
        "clipped_share": regions["clipped"]["fraction"],
        "confidence": figures["confidence"]["spearman_log2"],
        "chosen": figures["response"],
        "seconds": figures["train_seconds"],
        "seconds_to_final": figures["seconds_to_final"],
        "peak_memory_bytes": figures["peak_memory_bytes"],
        "gaussians": figures["gaussians"],
        "renders_per_second": figures["renders_per_second"],
        "shared_by": result["shared_by"],
        "tests": [[line["seconds"], line["psnr_mu"]] for line in result["curve"] if line.get("psnr_mu") is not None],
    }


def _submit(jobs, out: Path, run: str, device: str, at_once: int, slurm: dict | None, lpips: str | None) -> None:
    """Workers by submitit, each taking job after job; returns when all have ended."""
    try:
        import submitit
    except ImportError:
        raise SehdrError(
            "submitit starts several jobs at once and is not installed; pip install 'sehdr-warp[slurm]', or take "
            "--jobs 1"
        ) from None
    gpus = 0
    if device == "cuda" and slurm is None:
        import torch

        gpus = torch.cuda.device_count()
    submitted = []
    for worker in range(at_once):
        executor = submitit.AutoExecutor(folder=out / "logs", cluster="local" if slurm is None else "slurm")
        executor.update_parameters(timeout_min=LONGEST_DAYS * 24 * 60, name="sehdr-warp")
        if gpus:
            executor.update_parameters(gpus_per_node=1, visible_gpus=[worker % gpus])
        elif slurm is not None:
            one = {"gpus_per_node": 1} if device == "cuda" else {}
            own = {f"slurm_{key}" if key != "timeout_min" else key: value for key, value in slurm.items()}
            executor.update_parameters(**one, **own)
        shared = -(-at_once // gpus) if gpus else at_once if slurm is None else 1
        submitted.append(executor.submit(work, jobs, out.absolute(), run, device, shared, lpips))
    try:
        for job in submitted:
            job.wait()
            if error := job.exception():
                LOG.warning("a worker ended early: %s", str(error).strip().splitlines()[-1])
    except BaseException:
        for job in submitted:
            job.cancel()
        raise


def work(jobs: Sequence[Job], out: Path, run: str, device: str, shared_by: int, lpips: str | None) -> None:
    """A worker: takes the jobs that nobody is at, one after the other. Whoever holds the lock of a job's folder is at
    it; the operating system lets go of it when a worker dies, however it dies."""
    runner = Runner("cuda:0" if device == "cuda" else device, shared_by=shared_by, lpips=lpips)
    for job in jobs:
        folder = job.folder(out)
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(Timeout), FileLock(folder / "lock", timeout=0):
            if read_result(folder) is not None or (read_failure(folder) or {}).get("run") == run:
                continue
            # Stays if this process is killed: then no other worker of this run tries, and dies, again.
            write_failure(folder, run, "its process ended without a result")
            try:
                write_json(folder / RESULT, runner.run(job, folder), overwrite=True)
                (folder / FAILURE).unlink(missing_ok=True)
                LOG.info("%s: done", job.label)
            except SehdrError as error:
                write_failure(folder, run, str(error))
            except Exception as error:
                traceback.print_exc()
                write_failure(folder, run, f"{type(error).__name__}: {error}")
                if device == "cuda":
                    raise  # the device may be spoilt for this process; other workers go on


class Runner:
    """Runs jobs in this process; scenes, photos and kernels are kept from job to job."""

    def __init__(self, device: str, *, shared_by: int = 1, lpips: str | None = None):
        self.device, self.shared_by, self.lpips = device, shared_by, lpips
        self._warm: set[str] = set()

    def run(self, job: Job, folder: Path) -> dict:
        """Trains, evaluates and returns the result as it is to be written.

        Raises:
            SehdrError: where the scene has no truth, the training diverges, or a file cannot be used.
        """
        from ..evaluation.evaluate import evaluate
        from ..training.config_files import config_from_dict
        from ..training.train import train

        config, out = job.config, folder / "run"
        scene = exposed(job)
        shown = scene if config["sees_truth"] else without_training_truth(scene)
        training = config_from_dict(config["training"], job.label)
        self._warm_up(shown, training, folder)
        shutil.rmtree(out, ignore_errors=True)
        self._forget_peaks()
        run = train(shown, out, training, device=self.device)
        peak = self._peak_memory()
        weights = self.lpips if "lpips" in config["judged_by"] else None
        figures = evaluate(run, scene, lpips_weights=weights, flip="flip" in config["judged_by"])
        figures.pop("views")
        curve = run.metrics()
        figures |= {
            "response": run.response.name,
            "seconds_to_final": seconds_to_final(curve, run.train_seconds),
            "peak_memory_bytes": peak,
            "renders_per_second": self._render_rate(run, scene),
        }
        shutil.rmtree(out, ignore_errors=True)
        return {"format": FORMAT, "key": job.key, "label": job.label, "shared_by": self.shared_by, "config": config,
                "figures": figures, "curve": curve}  # fmt: skip

    def _warm_up(self, scene: Scene, config, folder: Path) -> None:
        from ..training.config_files import override_config
        from ..training.train import train

        # What is compiled depends on the shape of the computation, not on seeds, rates or lengths.
        shape = repr((config.model, config.response.name == "learned", config.fusion, config.densification.strategy))
        if shape in self._warm:
            return
        short = {"schedule.iterations": WARM_UP_ITERATIONS, "plan.enabled": False}
        scratch = folder / "warm-up"
        try:
            shutil.rmtree(scratch, ignore_errors=True)
            train(scene, scratch, override_config(config, short), device=self.device)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        self._warm.add(shape)

    def _forget_peaks(self) -> None:
        gc.collect()
        if self.device.startswith("cuda"):
            import torch

            torch.cuda.init()  # before a first use torch has no peaks to forget, and says so by an error
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(self.device)

    def _peak_memory(self) -> int | None:
        """Bytes of torch's tensors on a GPU; None on the CPU."""
        import torch

        return torch.cuda.max_memory_allocated(self.device) if self.device.startswith("cuda") else None

    def _render_rate(self, run, scene: Scene) -> float:
        """HDR renders of held-out views per second, called one after the other."""
        import torch

        from .timing import wait

        device = torch.device(self.device)
        cameras = [view.camera for view in scene.test_views or scene.train_views]
        with torch.no_grad():
            for camera in cameras[:3]:
                run.render(camera)
            wait(device)
            started, count = time.perf_counter(), 0
            while count < RENDERS and time.perf_counter() - started < RENDER_SECONDS:
                run.render(cameras[count % len(cameras)])
                wait(device)
                count += 1
        return count / (time.perf_counter() - started)


def exposed(job: Job) -> Scene:
    """The scene as the job's camera took it, with its truth."""
    config = job.config
    return _exposed(job.place, config["scene"]["max_size"], config["curve"], config["exposure"])


@lru_cache(maxsize=8)
def _exposed(place: str, max_size: int | None, curve: str, exposure: int) -> Scene:
    from ..response import response_by_name
    from ..synth.expose import expose, exposure_ladder

    truth, response = _true_scene(place, max_size), response_by_name(curve)
    return expose(truth, response, exposure_ladder(truth, response, EXPOSURES, FACTOR)[exposure])


@lru_cache(maxsize=4)
def _true_scene(place: str, max_size: int | None) -> Scene:
    """A scene with HDR truth in every view; raises InputError for one without."""
    scene = load_scene(place, max_size=max_size, response="srgb")
    for view in scene.views:
        if view.hdr is None:
            problem = f"view {view.name} has no HDR truth"
            raise InputError(place, problem, "only scenes with truth in every view can be benchmarked")
    return scene


def without_training_truth(scene: Scene) -> Scene:
    """The scene as a method that learns from photos alone may see it: no truth in the training views."""
    return replace(scene, views=tuple(replace(v, hdr=None) if v.split == "train" else v for v in scene.views))


def seconds_to_final(curve: Sequence[dict], total: float) -> float:
    """The first test from which on the held-out HDR figure stays within 0.1 dB of the last; else the LDR one."""
    key = "psnr_mu" if all("psnr_mu" in line for line in curve) else "psnr_ldr"
    reached = total
    for line in reversed(curve):
        if line.get(key) is None or line[key] < curve[-1][key] - NEAR_FINAL:
            break
        reached = line["seconds"]
    return min(reached, total)
