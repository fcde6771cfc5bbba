"""`bench training`: plain 3DGS on our kernels against gsplat's training, on equal terms."""

import gc
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch

from ..errors import InputError
from ..scene import Scene
from ..training.config import Config, stated
from ..training.config_files import config_to_dict, load_config
from ..training.train import train
from .kernels import OURS
from .machine import package_version
from .peer_gsplat import train_with_gsplat
from .peers import find_peers
from .report import new_report
from .step import make_trainer, thick_of_training

GSPLAT, GSPLAT_WITHOUT_RESETS = "gsplat", "gsplat without resets"
WARM_UP_STEPS = 40


def bench_training(
    scene: Scene,
    device: torch.device,
    *,
    iterations: int = 30_000,
    seed: int = 0,
    released: bool = False,
    out: Path | None = None,
    overwrite: bool = False,
    progress: Callable[[str], None] = lambda line: None,
) -> dict:
    """Train both sides and measure; returns the report.

    Both sides have the same photos, split, start points and colours, losses, learning rates and iterations, and 3DGS's
    thresholds as they stand, whatever the number of iterations. released: also train gsplat as version 1.5.3 does,
    which never resets opacities. out: keep our run in out/run; by default it is thrown away.
    Raises InputError for a scene on which the terms would not be equal.
    """
    _check_equal_terms(scene)
    config = plain_config(iterations, seed)
    settings = {"device": str(device), "scene": scene.name, "views": len(scene.views), "config": config_to_dict(config)}
    report = new_report("training", device, settings)
    peers, notes = find_peers(device)
    gsplat_version = next((peer.version for peer in peers if peer.name == GSPLAT), None)
    report["notes"] = [note for note in notes if note.startswith(GSPLAT)]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "run" if out is None else out / "run"
        report["rows"].append(_ours(scene, config, device, folder, overwrite))
    progress(_line(report["rows"][-1]))
    if gsplat_version is not None:
        for name, resets in ((GSPLAT, True), (GSPLAT_WITHOUT_RESETS, False))[: 2 if released else 1]:
            train_with_gsplat(scene, config, device, resets=resets, steps=min(WARM_UP_STEPS, iterations))
            _empty_memory(device)
            row = {"stage": "training", "implementation": name, "version": gsplat_version}
            report["rows"].append(row | train_with_gsplat(scene, config, device, resets=resets))
            progress(_line(report["rows"][-1]))
    return report


def plain_config(iterations: int, seed: int) -> Config:
    """The preset `3dgs` for so many iterations, with 3DGS's iteration numbers unscaled."""
    numbers = {
        "schedule.evaluate_at": [stated(iterations, iterations)],
        "schedule.checkpoint_every": stated(iterations, iterations),
        "schedule.harmonics_every": stated(1000, iterations),
        "densification.start": stated(500, iterations),
        # 3DGS densifies while iteration < 15000: neither a change nor a reset falls on 15000 itself.
        "densification.stop": stated(15_000, iterations),
        "densification.every": stated(100, iterations),
        "densification.reset_every": stated(3000, iterations),
    }
    return load_config(
        "3dgs",
        {
            "seed": seed,
            "schedule.iterations": iterations,
            **numbers,
        },
    )


def _check_equal_terms(scene: Scene) -> None:
    if not len(scene.points):
        raise InputError(scene.name, "has no points, from which both sides start", "take one with sparse points")
    times = sorted({view.exposure_time for view in scene.views})
    if times[0] != times[-1]:
        problem = f"has exposure times from {times[0]:g} to {times[-1]:g} s, and gsplat knows none"
        raise InputError(scene.name, problem, "use one exposure")


def _ours(scene: Scene, config: Config, device: torch.device, folder: Path, overwrite: bool) -> dict:
    _warm_up(scene, config, device)
    _empty_memory(device)
    run = train(scene, folder, config, device=device, overwrite=overwrite, quiet=True)
    summary, metrics = run.summary(), run.metrics()
    return {
        "stage": "training",
        "implementation": OURS,
        "version": package_version(OURS),
        "psnr_ldr": metrics[-1]["psnr_ldr"] if metrics else None,
        "train_seconds": summary["train_seconds"],
        "gaussians": summary["gaussians"],
        "iterations": run.iterations,
        "peak_gpu_memory_bytes": summary.get("peak_gpu_memory_bytes"),
    }


def _warm_up(scene: Scene, config: Config, device: torch.device) -> None:
    """Compiles and loads the kernels of every degree of the harmonics and of a densification, on a trainer of its own;
    gsplat's are warmed in the same way."""
    trainer = make_trainer(scene, config, device, 0)
    for degree in range(config.model.harmonics_degree + 1):
        trainer.iteration = degree * config.scaled(config.schedule.harmonics_every)
        for _ in range(WARM_UP_STEPS // 4 if device.type == "cuda" else 1):
            trainer.step()
    trainer.iteration = thick_of_training(config) + config.scaled(config.densification.every) - 1
    trainer.step()


def _empty_memory(device: torch.device) -> None:
    """What the side before has left behind must not count as the next one's peak."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def _line(row: dict) -> str:
    quality = "no held-out views" if row["psnr_ldr"] is None else f"{row['psnr_ldr']:.2f} dB"
    return f"{row['implementation']}: {quality}, {row['train_seconds']:.1f} s, {row['gaussians']} Gaussians"
