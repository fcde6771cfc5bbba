"""One job of `bench quality`, from the truth to its figures."""

import contextlib
import gc
import shutil
import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from ..errors import InputError
from ..evaluation.evaluate import evaluate
from ..response import response_by_name
from ..scene import Scene, load_scene
from ..synth.expose import SensorNoise, expose, exposure_ladder
from ..training.config import REFERENCE_ITERATIONS, Config
from ..training.config_files import config_from_dict, override_config
from ..training.plan import apply_plan
from ..training.train import train
from .machine import describe_machine, now, package_version
from .quality_jobs import FORMAT, Job

RUN = "run"
WARM_UP_ITERATIONS = 30
"""Of a training that is thrown away before the first of its kind in a process: kernels are compiled and loaded, on a
GPU steps are recorded. All schedules scale with the length, so every part of a training is in it."""
NEAR_FINAL = 0.1
"""dB below the final held-out figure that count as reaching it."""
RENDER_SECONDS, RENDERS = 1.0, 100
"""A render is timed for so long or so often, whichever ends first."""


class Runner:
    """Runs jobs in this process, one after the other; scenes, photos and kernels are kept from job to job.

    device: "cpu" or "cuda:0" and the like. lpips: folder of weights or None. shared_by: trainings that share the
    device, noted in each result. keep_runs: keep the trained models, not only their figures.
    """

    def __init__(self, device: str, *, lpips: str | None = None, shared_by: int = 1, keep_runs: bool = False):
        self.device, self.lpips, self.shared_by, self.keep_runs = device, lpips, shared_by, keep_runs
        self._warm: set[str] = set()
        self._machine: dict | None = None

    def run(self, job: Job, folder: Path) -> dict:
        """Trains, evaluates and returns the result as it is to be written.

        Raises SehdrError where the scene has no truth, the training diverges, or a file cannot be used.
        """
        config = job.config
        photographed, judged = photos(job)
        training = config_from_dict(config["training"], job.label)
        method, out = config["method"], folder / RUN
        scene = photographed if method["truth"] else without_training_truth(photographed)
        training, plan = apply_plan(scene, training)
        self._warm_up(method, scene, training, folder)
        shutil.rmtree(out, ignore_errors=True)
        self._forget_peaks()
        run = self._train(method, scene, training, out)
        peak = self._peak_memory()
        figures = evaluate(run, judged, lpips_weights=self.lpips if config["lpips"] else None, flip=config["flip"])
        curve = run.metrics()
        figures |= {
            "response": run.response.name,
            "seconds_to_final": seconds_to_final(curve, run.train_seconds),
            "peak_memory_bytes": peak,
            "render_fps": self._render_rate(run, judged),
        }
        del run
        if not self.keep_runs:
            shutil.rmtree(out, ignore_errors=True)
        self._machine = self._machine or describe_machine(torch.device(self.device))
        return {
            "format": FORMAT,
            "key": job.key,
            "job": job.name,
            "date": now(),
            "version": package_version("sehdr-warp"),
            "machine": self._machine,
            "shared_by": self.shared_by,
            "exposure_time": judged.views[0].exposure_time,
            "config": config,
            **({} if plan is None else {"plan": plan.to_dict()}),
            "figures": figures,
            "curve": curve,
            "complete": True,
        }

    def _train(self, method: dict, scene: Scene, config: Config, out: Path):
        return train(scene, out, config, device=self.device, quiet=True)

    def _warm_up(self, method: dict, scene: Scene, config: Config, folder: Path) -> None:
        # What is compiled depends on the shape of the computation, not on seeds, rates or lengths.
        learned = config.response.name == "learned"
        shape = repr((config.model, learned, config.fusion, config.loss, config.densification.strategy))
        if shape in self._warm:
            return
        count = min(WARM_UP_ITERATIONS, config.schedule.iterations)
        overrides = {"schedule.iterations": count, "schedule.evaluate_at": [REFERENCE_ITERATIONS]}
        scratch = folder / "warm-up"
        try:
            shutil.rmtree(scratch, ignore_errors=True)
            self._train(method, scene, override_config(config, overrides), scratch)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        self._warm.add(shape)

    def _forget_peaks(self) -> None:
        gc.collect()
        if self.device.startswith("cuda"):
            torch.cuda.init()  # before a first use torch has no peaks to forget, and says so by an error
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(self.device)
        # Linux: 5 resets the process's peak; elsewhere the peak is that of all jobs so far, and is left out.
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")

    def _peak_memory(self) -> int | None:
        """Bytes: of torch's tensors on a GPU, of the process on the CPU (Linux; else None)."""
        if self.device.startswith("cuda"):
            return torch.cuda.max_memory_allocated(self.device)
        with contextlib.suppress(OSError):
            for line in Path("/proc/self/status").read_text().splitlines():
                if line.startswith("VmHWM:"):
                    return 1024 * int(line.split()[1])
        return None

    @torch.no_grad()
    def _render_rate(self, run, scene: Scene) -> float:
        """HDR renders of held-out views per second, called one after the other."""
        cameras = [view.camera for view in scene.test_views or scene.train_views]
        for camera in cameras[:3]:
            run.render(camera)
        self._wait()
        started, count = time.perf_counter(), 0
        while count < RENDERS and time.perf_counter() - started < RENDER_SECONDS:
            run.render(cameras[count % len(cameras)])
            self._wait()
            count += 1
        return count / (time.perf_counter() - started)

    def _wait(self) -> None:
        if self.device.startswith("cuda"):
            torch.cuda.synchronize(self.device)


def photos(job: Job) -> tuple[Scene, Scene]:
    """The scene as the job's camera took it, and the same without noise, which is what renders are judged by.

    The regions of the evaluation (clipped, well-exposed, dark) follow from the second: from the truth through the
    response at the exposure that was trained on.
    """
    photo = job.config["photo"]
    noise = None if photo["noise"] is None else tuple(photo["noise"])
    return _photos(
        job.place,
        job.config["scene"]["max_size"],
        photo["curve"],
        photo["exposure"],
        photo["count"],
        photo["factor"],
        noise,
        job.config["seed"] if noise else 0,
    )


@lru_cache(maxsize=8)
def _photos(place, max_size, curve, exposure, count, factor, noise, seed) -> tuple[Scene, Scene]:
    truth, response = true_scene(place, max_size), response_by_name(curve)
    exposure_time = exposure_ladder(truth, response, count, factor)[exposure]
    clean = expose(truth, response, exposure_time)
    if noise is None:
        return clean, clean
    noisy = expose(truth, response, exposure_time, noise=SensorNoise(*noise), seed=seed)
    views = tuple(view if view.split == "train" else other for view, other in zip(noisy.views, clean.views))
    return replace(noisy, views=views), clean


@lru_cache(maxsize=4)
def true_scene(place: str, max_size: int | None) -> Scene:
    """A scene with HDR truth in every view; raises InputError for one without."""
    scene = load_scene(place, max_size=max_size, response="srgb")
    for view in scene.views:
        if view.hdr is None:
            raise InputError(
                place, f"view {view.name} has no HDR truth", "only scenes with truth in every view can be benchmarked"
            )
        if not np.isfinite(view.hdr).all():
            raise InputError(place, f"the HDR truth of view {view.name} is not finite", "render it again")
    return scene


def without_training_truth(scene: Scene) -> Scene:
    """The scene as a method that learns from photos alone may see it: no truth in the training views."""
    return replace(scene, views=tuple(replace(v, hdr=None) if v.split == "train" else v for v in scene.views))


def seconds_to_final(curve: list[dict], total: float) -> float:
    """The first test from which on the held-out HDR figure stays within 0.1 dB of the last; else the LDR one."""
    key = "psnr_mu" if all("psnr_mu" in line for line in curve) else "psnr_ldr"
    reached = total
    for line in reversed(curve):
        if line.get(key) is None or line[key] < curve[-1][key] - NEAR_FINAL:
            break
        reached = line["seconds"]
    return min(reached, total)
