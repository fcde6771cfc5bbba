"""`python -m benchmarks quality`: train and evaluate every combination of methods with scenes and exposures.

A combination is a job with its folder and key. Several jobs run at a time, each once; their results become rows.
"""

import contextlib
import hashlib
import json
import logging
import re
import shutil
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain, cycle, product
from pathlib import Path

import torch
from filelock import FileLock, Timeout

from benchmarks.irradiance import LIGHT, irradiance_error, read_light_maps, store_light
from sehdr_warp.blocks.jobs import local_executors, slurm_executor, visible_gpus
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.evaluation.evaluate import evaluate
from sehdr_warp.evaluation.metrics import REGIONS
from sehdr_warp.evaluation.protocols import PROTOCOLS
from sehdr_warp.files import read_json, write_json
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import REFERENCE_ITERATIONS, Config
from sehdr_warp.runs.config_files import config_from_dict, load_config, override_config, preset_names
from sehdr_warp.scene import Scene, embedded_folder, is_embedded, load_scene
from sehdr_warp.synth.expose import expose, exposure_ladder
from sehdr_warp.training.train import train

from .timing import Variant, forget_peaks, time_variants

LOG = logging.getLogger(__name__)
FORMAT = 8  # Version of jobs and results; jobs of other versions run again.
RESULT, FAILURE = "result.json", "failure.json"
EXPOSURES, FACTOR = 5, 4.0  # Exposures of a scene, each FACTOR times longer than the last, around a well exposed one
KNOWN, BLIND, LEARNED = "known", "blind", "learned"
"""A method gets the curve, chooses one, or learns it; if it learns it, known and blind are one training."""
UPPER_BOUND = "truth"  # 3DGS trained on the HDR truth, which every method is compared with
METHOD_FIELDS = (
    "response.name",
    *("fusion.enabled", "loss.form", "loss.ldr_weight", "loss.hdr_weight", "loss.linear_weight"),
)
"""Fields that make a method: its plan does not change them. Steps, learning rates and the largest number of Gaussians
are planned for every method alike, also where its preset has no plan."""
WARM_UP_ITERATIONS = 30
"""Length of a training before the first of its kind in a process, for compiling kernels and capturing CUDA graphs.
All schedules scale with the length, so every part of a training is in it."""
_warm: set[str] = set()


@dataclass(frozen=True)
class Job:
    """One training and its evaluation.

    config: everything that decides the result, plain values; its hash is the key. place: where the scene is, which is
    no part of the key, since folders move.
    """

    config: dict
    place: str

    @property
    def key(self) -> str:
        """Return a hash of everything that decides the job's result."""
        text = json.dumps(self.config, sort_keys=True, ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def label(self) -> str:
        """Return the job in words."""
        config = self.config
        where = f"{config['scene']['name']} {config['curve']} exposure {config['exposure']}"
        return f"{where} {config['method']} {config['response']} seed {config['seed']}"

    def folder(self, out: Path) -> Path:
        """Return the job's folder."""
        return out / "jobs" / f"{re.sub(r'[^A-Za-z0-9.]+', '-', self.label)[:100].strip('-')}-{self.key}"

    def result(self, out: Path) -> dict | None:
        """Return the complete result; None if there is none, or one of another config, or one that was cut short."""
        result = _read(self.folder(out) / RESULT)
        whole = "figures" in result and (result.get("format"), result.get("key")) == (FORMAT, self.key)
        return result if whole else None


def plan_jobs(
    scenes: Sequence[str],
    methods: Sequence[str],
    *,
    curves: Sequence[str] = ("hdr-nerf",),
    exposures: Sequence[int] = (2,),
    responses: Sequence[str] = (KNOWN,),
    seeds: Sequence[int] = (0,),
    iterations: int | None = None,
    max_size: int | None = None,
    device: str = "cpu",
    lpips: bool = False,
) -> list[Job]:
    """Return a job for every combination.

    Methods that learn the response have one job for known and blind together; those that take nothing from photos have
    none that is blind.

    exposures: places in the ladder. iterations: None is the preset's own, or its plan's. device: kind, "cpu" or "cuda".

    Raises SehdrError for a preset, field, curve or folder that cannot be used, before anything runs.
    """
    for item in set(exposures) - set(range(EXPOSURES)):
        raise SehdrError(f"exposure {item} is not one of 0 to {EXPOSURES - 1}")
    for item in set(responses) - {KNOWN, BLIND}:
        raise SehdrError(f"response {item!r} is not one of {KNOWN}, {BLIND}")
    for note in chain.from_iterable(response_by_name(curve).notes for curve in curves):
        LOG.info("%s", note)
    titles = [place.removeprefix("embedded:") if is_embedded(place) else Path(place).resolve().name for place in scenes]
    for what, names, file in (("scenes", titles, "folder"), ("methods", [Path(m).stem for m in methods], "TOML file")):
        if len(set(names)) < len(names):
            raise SehdrError(f"two {what} have one name; rename a {file} so that tables can tell them apart")
    places = {place: {"name": name, "sha256": _digest(place)} for place, name in zip(scenes, titles, strict=True)}
    jobs = []
    for method, seed, place, curve, exposure, response in product(methods, seeds, scenes, curves, exposures, responses):
        config = _training(method, iterations, seed)
        if config.response.name == LEARNED:
            if response != responses[0]:
                continue
            response = LEARNED
        elif config.loss.ldr_weight == 0 and response == BLIND:
            continue
        curve_name = {KNOWN: curve, BLIND: "auto"}.get(response, config.response.name)
        trained = override_config(config, {"response.name": curve_name}, method)
        decided = {
            "format": FORMAT,
            "scene": places[place] | {"max_size": max_size},
            "curve": curve,
            "curve_sha256": _digest(curve) if Path(curve).is_file() else None,
            "exposure": exposure,
            "method": Path(method).stem,
            "sees_truth": trained.loss.uses_hdr,
            "response": response,
            "seed": seed,
            "device": device,
            "lpips": lpips,
            "training": json.loads(json.dumps(trained.model_dump())),
        }
        jobs.append(Job(decided, place if is_embedded(place) else str(Path(place).absolute())))
    if not jobs:
        remedy = f"choose methods from {', '.join(preset_names())}; those that take nothing from photos need known"
        raise SehdrError(f"there is nothing to train: {remedy} in --responses")
    return jobs


def _training(method: str, iterations: int | None, seed: int) -> Config:
    """Return the method's training by the plan; held-out views are evaluated at its end alone."""
    changes = {} if iterations is None else {"schedule.iterations": iterations}
    config = load_config(method, {"seed": seed, **changes})
    times = {"schedule.evaluate_at": [REFERENCE_ITERATIONS], "schedule.checkpoint_every": REFERENCE_ITERATIONS}
    plan = {"plan.enabled": True, "plan.keep": sorted({*config.plan.keep, *changes, *METHOD_FIELDS})}
    return override_config(config, times | plan, method)


def _read(path: Path) -> dict:
    """Read a JSON file; return an empty dictionary if it is missing or damaged."""
    with contextlib.suppress(InputError):
        return read_json(path)
    return {}


def _folder(place: str) -> Path:
    return embedded_folder(place) if is_embedded(place) else Path(place)


def _digest(place: str) -> str:
    """Return a hash of a file, or of all files of a folder or embedded scene with their names."""
    folder = _folder(place)
    if not folder.exists():
        raise InputError(place, "no such folder", "give folders with HDR truth, or embedded")
    digest = hashlib.sha256()
    for path in sorted(path for path in [folder, *folder.rglob("*")] if path.is_file()):
        digest.update(str(path.relative_to(folder)).encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def run_jobs(
    jobs: Sequence[Job],
    out: Path,
    *,
    device: str,
    at_once: int = 1,
    slurm: dict | None = None,
    lpips: str | None = None,
) -> list[dict]:
    """Run the jobs that have no result in out/jobs; return a row for each job: its result, or its label and error.

    device: kind, "cpu" or "cuda". at_once: trainings at one time; more than one, or any on SLURM, by submitit. slurm:
    parameters of SLURM jobs such as {"partition": "gpu"}, None for this machine. lpips: folder of weights.
    """
    open_jobs = [job for job in jobs if job.result(out) is None]
    LOG.info("%d jobs, %d of them to do", len(jobs), len(open_jobs))
    for job in open_jobs:
        (job.folder(out) / FAILURE).unlink(missing_ok=True)
    at_once = max(1, min(at_once, len(open_jobs)))
    if at_once == 1 and slurm is None:
        work(open_jobs, out, device, 1, lpips)
    elif open_jobs:
        _submit(open_jobs, out, device, at_once, slurm, lpips)
    rows = []
    for job in jobs:
        if result := job.result(out):
            rows.append(row_of(result))
        else:
            error = _read(job.folder(out) / FAILURE).get("error", "no worker was left to run it")
            rows.append({"label": job.label, "error": error})
    return rows


def row_of(result: dict) -> dict:
    """Return a result as one flat row: what was trained, and its figures."""
    config, figures = result["config"], result["figures"]
    hdr, regions = figures["protocol"], figures["regions"]
    names = ("curve", "exposure", "method", "sees_truth", "response", "seed", "device")
    return {
        "scene": config["scene"]["name"],
        **{name: config[name] for name in names},
        **{name: figures[name] for name in ("iterations", "gaussians", "peak_memory_bytes", "renders_per_second")},
        **{name.replace("-", "_"): hdr[name]["psnr_mu"] for name in PROTOCOLS},
        "ssim": hdr["gt-max"]["ssim_mu"],
        "lpips": hdr["gt-max"]["lpips_mu"],
        "ldr": figures["ldr"]["psnr"],
        **{region.replace("-", "_"): regions[region]["psnr_mu"]["aligned"] for region in REGIONS},
        **{f"lights_{name}": figures["lights"][name] for name in ("count", "lost")},
        "light_energies": figures["lights"]["energies"],
        "irradiance": figures["irradiance"],
        "clipped_share": regions["clipped"]["fraction"],
        "confidence": figures["confidence"]["spearman_log2"],
        "chosen": figures["response"],
        "seconds": figures["train_seconds"],
        "shared_by": result["shared_by"],
    }


def _submit(jobs, out: Path, device: str, at_once: int, slurm: dict | None, lpips: str | None) -> None:
    """Start workers by submitit, each of which runs job after job; return when all have ended."""
    logs, count = out / "logs", torch.cuda.device_count() if device == "cuda" and slurm is None else 0
    shared = -(-at_once // count) if count else at_once if slurm is None else 1
    if slurm is None:
        executors = local_executors(logs, at_once, visible_gpus(torch.device(device), count) if count else [])
    else:
        executors = [slurm_executor(logs, slurm, gpu=device == "cuda")] * at_once
    workers = [executor.submit(work, jobs, out.absolute(), device, shared, lpips) for executor in executors]
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
    """Run as a worker the jobs that no other worker runs, one after the other.

    A worker holds the lock of its job's folder; the operating system releases it when the worker ends, in whatever way.
    """
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
                write_json(folder / RESULT, result | {"shared_by": shared_by}, internal=True)
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
    write_json(folder / FAILURE, {"error": " ".join(error.split())[:1000]}, internal=True)


def run_job(job: Job, folder: Path, device: str, lpips: str | None) -> dict:
    """Trains, evaluates and returns the result as it is to be written. Scenes, photos and kernels stay for the next.

    Raises SehdrError where the scene has no truth, the training diverges, or a file cannot be used.
    """
    config, out = job.config, folder / "run"
    scene = exposed(job.place, config["scene"]["max_size"], config["curve"], config["exposure"])
    training = config_from_dict(config["training"], job.label)
    # A method that learns from photos alone sees no truth in the training views.
    views = [replace(view, hdr=None) if view.split == "train" else view for view in scene.views]
    train_scene = scene if config["sees_truth"] else replace(scene, views=tuple(views))
    _warm_up(train_scene, training, folder / "warm-up", device)
    shutil.rmtree(out, ignore_errors=True)
    forget_peaks(torch.device(device))
    run = train(train_scene, out, training, device=device)
    peak = torch.cuda.max_memory_allocated(device) if device.startswith("cuda") else None
    figures = evaluate(run, scene, lpips_weights=lpips if config["lpips"] else None)
    figures.pop("views")
    light_inputs = read_light_maps(_folder(job.place)), [view.camera for view in scene.train_views]
    scale = figures["protocol"]["aligned"]["scale"] or 1.0
    figures["irradiance"] = irradiance_error(run, *light_inputs, scale)
    store_light(folder / LIGHT, run, *light_inputs, scale)
    figures |= {"response": run.response.name, "peak_memory_bytes": peak}
    figures["renders_per_second"] = _render_rate(run, scene)
    shutil.rmtree(out, ignore_errors=True)
    return {"format": FORMAT, "key": job.key, "config": config, "figures": figures}


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
    """Return a scene with its truth, as a job's camera took it: by a curve, at a place in the ladder of exposures."""
    truth, response = _true_scene(place, max_size), response_by_name(curve)
    return expose(truth, response, exposure_ladder(truth, response, EXPOSURES, FACTOR)[exposure])


@lru_cache(maxsize=4)
def _true_scene(place: str, max_size: int | None) -> Scene:
    scene = load_scene(place, max_size=max_size, response="srgb")
    for view in (view for view in scene.views if view.hdr is None):
        problem = f"view {view.name} has no HDR truth"
        raise InputError(place, problem, "only scenes with truth in every view can be benchmarked")
    return scene
