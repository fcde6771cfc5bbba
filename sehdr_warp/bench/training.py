"""`bench training`: plain 3DGS on our kernels against gsplat's training, on equal terms."""

import tempfile
from pathlib import Path

import torch

from ..scene import Scene
from ..training.config_files import load_config, override_config
from ..training.train import train
from .gsplat_peer import GSPLAT, note_missing, train_with_gsplat
from .kernels import OURS
from .results import new_result
from .timing import forget_peaks, held_memory

WARM_UP_STEPS = 40
COLUMNS = {
    "trained by=implementation": "", "iterations": ",d", "LDR dB=psnr_ldr": ".2f", "seconds=train_seconds": ".1f",
    "Gaussians=gaussians": ",d", "peak MiB=peak_memory_bytes": "MiB",
}  # fmt: skip


def bench_training(scene: Scene, device: torch.device, *, iterations: int = 30_000) -> dict:
    """The preset `3dgs` on both sides, with the same photos, split, start, losses, rates and iterations; a result."""
    config = load_config("3dgs", {"schedule.iterations": iterations})
    result = new_result("training", device, {"device": str(device), "scene": scene.name, "iterations": iterations})
    short = override_config(config, {"schedule.iterations": WARM_UP_STEPS}, "3dgs")
    with tempfile.TemporaryDirectory() as folder:
        train(scene, Path(folder) / "warm-up", short, device=device)
        forget_peaks(device)
        run = train(scene, Path(folder) / "run", config, device=device)
        held_out = (run.metrics() or [{}])[-1]
        row = {"psnr_ldr": held_out.get("psnr_ldr"), "train_seconds": run.train_seconds}
        row |= {"gaussians": run.gaussian_count, "peak_memory_bytes": held_memory(device)}
        rows = [{"implementation": OURS} | row]
    if note_missing(result, device):
        train_with_gsplat(scene, config, device, steps=WARM_UP_STEPS)
        forget_peaks(device)
        rows.append({"implementation": GSPLAT} | train_with_gsplat(scene, config, device))
    result["rows"] = [row | {"iterations": iterations} for row in rows]
    return result
