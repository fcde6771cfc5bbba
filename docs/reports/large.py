"""Large synthetic scenes: `default` beside gsplat's simple trainer, at one count of Gaussians.

python docs/reports/large.py 1M@1600x1200 --json docs/reports/results/large.json

Both start from the scene's points, one Gaussian each, and move those that nobody needs. Photos stay codes on the GPU
for both. gsplat (1.5.3) is trained as in captures.py.
"""

import logging
import shutil
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
import tyro
from captures import WARM_UP, figures, photographed, train_gsplat

from sehdr_warp.bench.results import finish, new_result
from sehdr_warp.bench.splats import Size, make_photo_scene, parse_size
from sehdr_warp.bench.timing import forget_peaks, held_memory, wait
from sehdr_warp.scene import Scene
from sehdr_warp.training.config_files import load_config
from sehdr_warp.training.train import Training

LOG = logging.getLogger("large")
HELD_OUT = 8
"""Of so many photos one is held out."""


def main(sizes: tyro.conf.Positional[tuple[str, ...]], /, json: Path, photos: int = 24, iterations: int = 1000) -> None:
    """Compare on scenes of these sizes, Gaussians@WIDTHxHEIGHT."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    result = new_result("large", torch.device("cuda"), {"photos": photos, "iterations": iterations})
    for size in map(parse_size, sizes):
        result["rows"] += compare(size, photos, iterations)
    finish(result, json, overwrite=True)


def compare(size: Size, photos: int, iterations: int, device: str = "cuda:0") -> list[dict]:
    """A row for each of ours and gsplat's."""
    scene = _scene(size, photos, device)
    fixed = {"densification.max_gaussians": size.gaussians, "densification.budget": 0, "model.initial_density": 0}
    fixed |= {"response.name": "srgb", "plan.enabled": False, "schedule.iterations": iterations}
    config = load_config("default", fixed)
    place = {"photos": f"{len(scene.train_views)} + {len(scene.test_views)}", "iterations": iterations}
    place |= {"width": size.width, "height": size.height}
    rows: list[dict] = []

    def add(method: str, render, count: int, seconds: float, memory: int) -> None:
        row = place | {
            "method": method,
            "gaussians": count,
            "step_ms": seconds * 1e3 / (iterations - iterations // WARM_UP),
            "memory": memory,
        }
        seen = [figures(render(view), view, run.model.response, None, device) for view in scene.test_views]
        row |= {name: float(np.mean([each[name] for each in seen])) for name in ("psnr", "ssim")}
        rows.append(row | {"over_ours": row["step_ms"] / rows[0]["step_ms"] if rows else 1.0})
        LOG.info("%s", rows[-1])

    forget_peaks(torch.device(device))
    scratch = Path(tempfile.mkdtemp())
    training = Training(scene, scratch / "run", config, device=device)
    begun, memory = 0.0, 0
    for step in training:
        if step.iteration == iterations // WARM_UP:
            training.timed(partial(wait, training.device))
            begun = training.seconds
        memory = held_memory(training.device) or 0
    run = training.run
    add("sehdr-warp", lambda view: photographed(run, view), run.gaussian_count, training.seconds - begun, memory)
    rows[0]["tests"] = [[line["iteration"], line["psnr_ldr"]] for line in training.folder.read_metrics()]
    shutil.rmtree(scratch)
    del training
    forget_peaks(torch.device(device))
    torch.manual_seed(0)
    trained = train_gsplat(scene, "mcmc", config, size.gaussians, device)
    memory = torch.cuda.max_memory_allocated(device)
    add("gsplat mcmc", trained, trained.count(), trained.loop_seconds, memory)
    return rows


def _scene(size: Size, photos: int, device: str) -> Scene:
    made = make_photo_scene(size, photos, device)
    views = [replace(view, split="train" if k % HELD_OUT else "test") for k, view in enumerate(made.views)]
    return replace(made, views=tuple(views))


if __name__ == "__main__":
    tyro.cli(main)
