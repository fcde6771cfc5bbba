"""Large synthetic scenes: `default` beside gsplat's simple trainer, at one count of Gaussians.

python -m benchmarks.large 1M@1600x1200 --json docs/reports/results/large.json

Both start from the scene's points, one Gaussian each, and move those that nobody needs. Photos stay codes on the GPU
for both. gsplat (1.5.3) is trained as in gsplat_trainer.py.
"""

import logging
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene import Scene
from sehdr_warp.scene.normalization import normalization_of
from sehdr_warp.training.train import create_trainer

from .captures import figures, photograph
from .gsplat_trainer import GsplatScene, Snapshot, train_gsplat
from .results import finish, new_result
from .splats import Size, make_photo_scene, parse_size
from .study import run
from .timing import forget_peaks, held_memory

LOG = logging.getLogger("large")
RESPONSE = "srgb"
WARM_UP = 5  # The first 1 / WARM_UP of a training is not timed, because kernels load and photos are matched
HELD_OUT = 8  # One of HELD_OUT photos is held out


def main(sizes: tuple[str, ...], /, json: Path, photos: int = 24, iterations: int = 1000) -> None:
    """Compare on synthetic scenes.

    Args:
        sizes: Gaussians@WIDTHxHEIGHT, such as 1M@1600x1200.
        json: file of the result.
        photos: of a scene, of which one in eight is held out.
        iterations: of a training.
    """
    result = new_result("large", torch.device("cuda"), {"photos": photos, "iterations": iterations})
    for size in map(parse_size, sizes):
        result["rows"] += compare(size, photos, iterations)
    finish(result, json, overwrite=True)


def compare(size: Size, photos: int, iterations: int, device: str = "cuda:0") -> list[dict]:
    """Train by ours and by gsplat's rasterizer; return a row for each."""
    scene = make_photo_scene(size, photos, device)
    views = (replace(view, split="train" if k % HELD_OUT else "test") for k, view in enumerate(scene.views))
    scene = replace(scene, views=tuple(views))
    fixed = {"densification.cap_max": size.gaussians, "mcmc.cap_density": 0, "model.initial_density": 0}
    fixed |= {"response.name": RESPONSE, "plan.enabled": False, "schedule.iterations": iterations}
    config = load_config("default", fixed)
    place = {"photos": f"{len(scene.train_views)} + {len(scene.test_views)}", "iterations": iterations}
    place |= {"width": size.width, "height": size.height}
    rows: list[dict] = []
    for train in (_train, _train_gsplat):
        forget_peaks(torch.device(device))
        row = place | train(scene, config, device)
        row["step_ms"] = row.pop("seconds") * 1e3 / (iterations - iterations // WARM_UP)
        rows.append(row | {"over_ours": row["step_ms"] / rows[0]["step_ms"] if rows else 1.0})
        LOG.info("%s", rows[-1])
    return rows


def _train(scene: Scene, config: Config, device: str) -> dict:
    scratch, begun, memory = Path(tempfile.mkdtemp()), 0.0, 0
    training = create_trainer(scene, scratch / "run", config, device=device)
    for step in training:
        if step.iteration == step.total // WARM_UP:
            training.synchronize()
            begun = training.seconds
        memory = held_memory(training.device) or 0
    row = {"method": "sehdr-warp", "gaussians": training.run.gaussian_count, "seconds": training.seconds - begun}
    row["tests"] = [[line["iteration"], line["psnr_ldr"]] for line in training.run.metrics()]
    row |= {"memory": memory} | _means(lambda view: photograph(training.run, view), scene, device)
    shutil.rmtree(scratch)
    return row


def _train_gsplat(scene: Scene, config: Config, device: str) -> dict:
    normalized, steps, seconds = normalization_of(scene), config.schedule.iterations, []

    def look(model: GsplatScene, snapshot: Snapshot) -> None:
        seconds.append(snapshot.seconds)

    trained = train_gsplat(
        normalized.scene(scene),
        "mcmc",
        device,
        steps=steps,
        fewest_points=0,
        cap_max=config.densification.cap_max,
        look_at=(steps // WARM_UP, steps),
        look=look,
    )
    row = {"method": "gsplat mcmc", "gaussians": trained.count, "seconds": seconds[1] - seconds[0]}
    row["memory"] = torch.cuda.max_memory_allocated(device)
    with torch.no_grad():
        return row | _means(lambda view: trained.render(normalized.camera(view.camera))[0], scene, device)


def _means(render: Callable, scene: Scene, device: str) -> dict[str, float]:
    response = response_by_name(RESPONSE)
    values = [figures(render(view), view, response, None, device) for view in scene.test_views]
    return {name: float(np.mean([each[name] for each in values])) for name in ("psnr", "ssim")}


if __name__ == "__main__":
    run(main)
