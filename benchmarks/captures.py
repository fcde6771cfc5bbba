"""Photos as people take them: `sehdr-warp train` as it is typed beside gsplat as its own trainer runs it.

    python -m benchmarks.captures FOLDER ... --max-size 500 --json docs/reports/results/captures.json

Ours plans its own steps. gsplat (gsplat_trainer.py) trains 30,000 steps in a normalized world with its own schedule,
start and budget, and is looked at after 7,000 steps too. The split is the same. Photos have the exposure that their
EXIF states, and ours shows a held-out photo at its own; gsplat knows of no exposure, so `psnr_fitted` grants every
method the best exposure of each held-out photo. Masks count for training and figures of all. Seconds are those of
steps, without loading, planning and looking; `reached` is the second at which ours has the PSNR that the better
strategy of gsplat has at its end.
"""

import logging
import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sehdr_warp.evaluation.metrics import psnr, ssim
from sehdr_warp.evaluation.perceptual import load_lpips
from sehdr_warp.response import Response
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run import Run
from sehdr_warp.scene import Scene, View, load_scene
from sehdr_warp.scene.normalization import normalization_of
from sehdr_warp.training.initialization import response_for_training
from sehdr_warp.training.train import train

from .gsplat_trainer import STEPS, STRATEGIES, GsplatScene, Snapshot, train_gsplat
from .results import finish, new_result
from .study import run
from .timing import forget_peaks

LOG = logging.getLogger("captures")
STOPS = np.linspace(-1, 1, 41).tolist()  # Exposures that are tried for psnr_fitted
LOOK_AT = (7_000, STEPS)  # simple_trainer.py's eval_steps


def main(
    folders: tuple[Path, ...],
    /,
    json: Path,
    max_size: int = 500,
    seeds: tuple[int, ...] = (0,),
    lpips: Path | None = None,
    strategies: tuple[str, ...] = STRATEGIES,
) -> None:
    """Compare on each folder of photos.

    Args:
        folders: of photos.
        json: the file that the result is written to.
        max_size: of the photos' longest side in pixels.
        seeds: of the trainings.
        lpips: a folder with LPIPS weights.
        strategies: gsplat's.
    """
    result = new_result("captures", torch.device("cuda"), {"max_size": max_size})
    for folder in folders:
        scene = load_scene(folder, max_size=max_size)
        for seed in seeds:
            result["rows"] += compare(scene, seed, lpips, strategies)
    finish(result, json, overwrite=True)


def compare(
    scene: Scene, seed: int, lpips: Path | None, strategies: tuple[str, ...] = STRATEGIES, device: str = "cuda:0"
) -> list[dict]:
    """Return a row of held-out figures for each method."""
    metric, rows = load_lpips(lpips, torch.device(device))[0], []
    place = {"capture": scene.name, "photos": f"{len(scene.train_views)} + {len(scene.test_views)}"}
    place |= {"size": max(scene.views[0].codes.shape), "seed": seed}

    def add(method: str, response: Response, render: Callable[[View], Tensor], **values) -> None:
        with torch.no_grad():
            each = [figures(render(view), view, response, metric, device) for view in scene.test_views]
        means = {name: float(np.mean([row[name] for row in each])) for name in each[0]}
        memory = torch.cuda.max_memory_allocated(device)
        rows.append(place | {"method": method, "memory": memory} | values | means)
        LOG.info("%s", rows[-1])

    scratch = Path(tempfile.mkdtemp())
    forget_peaks(torch.device(device))
    run = train(scene, scratch / "run", load_config("default", {"seed": seed}), device=device)
    scores = [(line["seconds"], line["psnr_ldr"]) for line in run.metrics()]
    values = {"iterations": run.iterations, "seconds": run.train_seconds, "gaussians": run.gaussian_count}
    values["best"] = max(score for _, score in scores)
    add("sehdr-warp", run.response, lambda view: photograph(run, view), **values)
    shutil.rmtree(scratch)
    response, normalized = response_for_training(scene, load_config("default")), normalization_of(scene)
    for strategy in strategies:
        forget_peaks(torch.device(device))

        def look(model: GsplatScene, at: Snapshot, strategy: str = strategy) -> None:
            def render(view: View) -> Tensor:
                return model.render(normalized.camera(view.camera))[0]

            values = {"iterations": at.step, "seconds": at.seconds, "gaussians": model.count}
            add(f"gsplat {strategy}", response, render, **values)

        train_gsplat(normalized.scene(scene), strategy, device, seed=seed, look_at=LOOK_AT, look=look)
    rivals = [row["psnr"] for row in rows if row["iterations"] == STEPS]
    rows[0]["reached"] = seconds_until(scores, max(rivals)) if rivals else None
    return rows


def seconds_until(scores: Iterable[tuple[float, float]], level: float) -> float | None:
    """Return the seconds of the first of (seconds, dB) that reaches a level in dB; None if none does."""
    return next((seconds for seconds, score in scores if score >= level), None)


@torch.no_grad()
def photograph(run: Run, view: View) -> Tensor:
    """Return [H, W, 3] encoded: the scene as the camera shows it, with the exposure and vignetting of that photo."""
    light = run.field.render(view.camera, degree=run.degree).hdr * view.exposure_time
    compensation = run.exposure_compensation
    if compensation is not None:
        light = light * torch.tensor(compensation.light(view), device=light.device, dtype=light.dtype)
    return run.field.response.encode_extended(light)


def figures(image: Tensor, view: View, response: Response, metric, device: str) -> dict[str, float]:
    """Return the figures of an encoded image [H, W, 3] beside a photo, where its mask counts."""
    photo = torch.tensor(view.image, device=device)
    mask = torch.ones(photo.shape[:2], device=device) if view.mask is None else torch.tensor(view.mask, device=device)
    image = torch.lerp(photo, image.float().clamp(0, 1), mask.float()[..., None])
    values = {"psnr": psnr(image, photo, mask), "ssim": ssim(image, photo, mask)}
    light = response.decode(image)
    exposed = (torch.lerp(photo, response.encode(light * 2**stops), mask.float()[..., None]) for stops in STOPS)
    values["psnr_fitted"] = max(psnr(exposed_render.clamp(0, 1), photo, mask) for exposed_render in exposed)
    return values | ({"lpips": metric(image, photo)} if metric else {})


if __name__ == "__main__":
    run(main)
