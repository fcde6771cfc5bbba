"""Photos as people take them: `default` beside gsplat's two strategies, on equal terms.

python -m benchmarks.captures FOLDER ... --max-size 500 --json docs/reports/results/captures.json

One split, size, iteration count, start (the set's points and those matched between the photos) and budget of Gaussians
for all. gsplat (1.5.3) is trained as its examples/simple_trainer.py does, every step scaled to the iterations as its
steps_scaler does; its default strategy stops growing at the budget. Photos have the exposure that their EXIF states,
and where the plan takes gains out of them, ours is shown with those of the held-out photo, which points that it shares
with others tell; gsplat knows of none. psnr_fitted grants each of all methods the best exposure of each held-out photo.
Each training has the GPU to itself.
"""

import logging
import shutil
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import torch
import tyro

from sehdr_warp.evaluation.metrics import psnr, ssim
from sehdr_warp.evaluation.perceptual import load_lpips
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.rasterizer.ssim import image_distance
from sehdr_warp.response import Response
from sehdr_warp.runs.config import REFERENCE_ITERATIONS
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run import Run
from sehdr_warp.scene import Scene, View, load_scene
from sehdr_warp.training.densification import gaussian_budget
from sehdr_warp.training.initialization import choose_response, make_matcher, scene_extent, start_points
from sehdr_warp.training.plan import make_plan
from sehdr_warp.training.train import train

from .results import finish, new_result
from .timing import forget_peaks

LOG = logging.getLogger("captures")
STRATEGIES = ("default", "mcmc")
WARM_UP = 5  # Of so many parts of a training the first is not in loop_seconds: kernels load, photos are matched
STOPS = np.linspace(-1, 1, 41).tolist()  # Of exposures that are tried


def main(
    folders: tyro.conf.Positional[tuple[Path, ...]],
    /,
    json: Path,
    max_size: int = 500,
    iterations: int | None = None,
    seeds: tuple[int, ...] = (0,),
    lpips: Path | None = None,
) -> None:
    """Compare on each folder of photos; iterations: of all, by default the plan's; lpips: a folder with LPIPS
    weights."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    result = new_result("captures", torch.device("cuda"), {"max_size": max_size})
    for folder in folders:
        scene = load_scene(folder, max_size=max_size)
        result["rows"] += [row for seed in seeds for row in compare(scene, seed, lpips, iterations)]
    finish(result, json, overwrite=True)


def compare(
    scene: Scene, seed: int, lpips: Path | None, iterations: int | None = None, device: str = "cuda:0"
) -> list[dict]:
    """A row of held-out figures for each method."""
    named = {} if iterations is None else {"schedule.iterations": iterations, "plan.keep": ("schedule.iterations",)}
    config = make_plan(scene, load_config("default", {"seed": seed, **named})).config
    stated = {"seed": seed, "schedule.iterations": config.schedule.iterations}
    config = load_config("default", stated | {"schedule.evaluate_at": (config.schedule.iterations,)})
    metric = load_lpips(lpips, torch.device(device))[0]
    photos = f"{len(scene.train_views)} + {len(scene.test_views)}"
    place = {"capture": scene.name, "photos": photos, "seed": seed, "iterations": config.schedule.iterations}
    rows, response = [], choose_response(scene, config)

    def add(method: str, render, count: int, seconds: float) -> None:
        seen = [figures(render(view), view, response, metric, device) for view in scene.test_views]
        means = {name: float(np.mean([row[name] for row in seen])) for name in seen[0]}
        memory = torch.cuda.max_memory_allocated(device)
        rows.append(place | {"method": method, "gaussians": count, "seconds": seconds, "memory": memory} | means)
        LOG.info("%s", rows[-1])

    scratch = Path(tempfile.mkdtemp())
    for warm_up in (True, False):
        forget_peaks(torch.device(device))
        given = load_config("default", stated | {"schedule.iterations": 60}) if warm_up else config
        run = train(scene, scratch / f"run{warm_up}", given, device=device)
    add("sehdr-warp", lambda view: photographed(run, view), run.gaussian_count, run.train_seconds)
    shutil.rmtree(scratch)
    budget = gaussian_budget(config.densification, sum(v.camera.width * v.camera.height for v in scene.train_views))
    for strategy in STRATEGIES:
        forget_peaks(torch.device(device))
        torch.manual_seed(seed)
        start = time.perf_counter()
        trained = train_gsplat(scene, strategy, config, budget, device)
        torch.cuda.synchronize(device)
        seconds = time.perf_counter() - start
        add(f"gsplat {strategy}", trained, trained.count(), seconds)
    return rows


@torch.no_grad()
def photographed(run: Run, view: View) -> torch.Tensor:
    """[H, W, 3] encoded: the scene as the camera would show it, with what it changed unsaid."""
    light = run.model.render(view.camera, degree=run.degree).hdr * view.exposure_time
    if run.photo_gains is not None:
        light = light * torch.tensor(run.photo_gains.light(view), device=light.device, dtype=light.dtype)
    return run.model.response.encode_extended(light)


@torch.no_grad()
def figures(image, view: View, response: Response, metric, device) -> dict[str, float]:
    """Of an image [H, W, 3], encoded, beside a photo."""
    photo, mask = _photo(view, device)
    image = torch.lerp(photo, image.float().clamp(0, 1), mask[..., None])
    found = {"psnr": psnr(image, photo, mask), "ssim": ssim(image, photo, mask)}
    light = response.decode(image)
    exposed = (torch.lerp(photo, response.encode(light * 2**stops), mask[..., None]) for stops in STOPS)
    found["psnr_fitted"] = max(psnr(shown.clamp(0, 1), photo, mask) for shown in exposed)
    return found | ({"lpips": metric(image, photo)} if metric else {})


def _photo(view: View, device) -> tuple[torch.Tensor, torch.Tensor]:
    """[H, W, 3] encoded and [H, W], what counts of it."""
    photo = torch.tensor(view.image, device=device)
    mask = torch.ones(photo.shape[:2], device=device) if view.mask is None else torch.tensor(view.mask, device=device)
    return photo, mask.float()


class Gsplat:
    """Gaussians as gsplat's examples hold them, and their render. loop_seconds: of all but the first steps of
    their training."""

    def __init__(self, start: Gaussians, device: str) -> None:
        tensors = {
            "means": start.means,
            "scales": start.log_scales,
            "quats": torch.rand(start.count, 4),
            "opacities": start.opacity_logits,
            "sh0": start.harmonics_dc,
            "shN": start.harmonics_rest,
        }
        self.splats = torch.nn.ParameterDict({k: torch.nn.Parameter(v.detach().to(device)) for k, v in tensors.items()})
        self.device = device
        self.degree, self.loop_seconds = 3, 0.0

    def count(self) -> int:
        return len(self.splats["means"])

    def render(self, camera, degree: int):
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]

        s = self.splats
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        image, _, info = rasterization(
            *(s["means"], s["quats"], s["scales"].exp(), s["opacities"].sigmoid(), torch.cat([s["sh0"], s["shN"]], 1)),
            torch.tensor(camera.world_to_camera[None], dtype=torch.float32, device=self.device),
            torch.tensor([matrix], dtype=torch.float32, device=self.device),
            *(camera.width, camera.height),
            sh_degree=degree,
            packed=False,
        )
        return image[0], info

    @torch.no_grad()
    def __call__(self, view: View):
        return self.render(view.camera, self.degree)[0]


def train_gsplat(scene: Scene, strategy: str, config, budget: int, device: str) -> Gsplat:
    """Trains as simple_trainer.py's `default` and `mcmc` do, from the points that our training starts from."""
    from gsplat import DefaultStrategy, MCMCStrategy  # pyright: ignore[reportMissingImports]

    rng = np.random.default_rng(config.seed)
    matcher = partial(make_matcher, scene, choose_response(scene, config), device)
    points, colors = start_points(scene, config, matcher, rng)
    points, colors = (torch.tensor(values, dtype=torch.float32) for values in (points, colors))
    opacity, scale = (0.5, 0.1) if strategy == "mcmc" else (0.1, 1.0)
    model = Gsplat(Gaussians.from_points(points, colors - 0.5, 3, opacity=opacity, scale=scale), device)
    extent, iterations = scene_extent(scene), config.schedule.iterations

    def scaled(step: int) -> int:
        return max(1, int(step * iterations / REFERENCE_ITERATIONS))

    rates = {"means": 1.6e-4 * extent, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3}
    rates["shN"] = rates["sh0"] / 20
    adam = {k: torch.optim.Adam([model.splats[k]], lr=rate, eps=1e-15, fused=True) for k, rate in rates.items()}
    decay = torch.optim.lr_scheduler.ExponentialLR(adam["means"], gamma=0.01 ** (1 / iterations))
    steps = {"refine_start_iter": scaled(500), "refine_every": scaled(100)}
    if strategy == "mcmc":
        rule = MCMCStrategy(cap_max=budget, refine_stop_iter=scaled(25_000), **steps)
        state = rule.initialize_state()
    else:
        rule = DefaultStrategy(refine_stop_iter=scaled(15_000), reset_every=scaled(3000), **steps)
        state = rule.initialize_state(scene_scale=extent)
    rule.check_sanity(model.splats, adam)
    views = scene.train_views
    codes = [torch.tensor(view.codes, device=device) for view in views]
    masks = [None if view.mask is None else torch.tensor(view.mask, device=device)[..., None] for view in views]
    order = torch.randperm(len(views)).tolist()
    started = 0.0
    for step in range(iterations):
        if step == iterations // WARM_UP:
            torch.cuda.synchronize(device)
            started = time.perf_counter()
        if step % len(views) == 0:
            order = torch.randperm(len(views)).tolist()
        index = order[step % len(views)]
        image, info = model.render(views[index].camera, min(step // scaled(1000), 3))
        if strategy == "default":
            rule.step_pre_backward(model.splats, adam, state, step, info)
        photo, mask = codes[index].float() / views[index].levels, masks[index]
        loss = image_distance(image if mask is None else torch.lerp(photo, image, mask), photo, 0.8, 0.2)
        if strategy == "mcmc":
            loss = loss + 0.01 * model.splats["opacities"].sigmoid().mean() + 0.01 * model.splats["scales"].exp().mean()
        loss.backward()
        for optimizer in adam.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        rate = adam["means"].param_groups[0]["lr"]
        decay.step()
        if strategy == "mcmc":
            rule.step_post_backward(model.splats, adam, state, step, info, lr=rate)
        else:
            if model.count() >= budget:
                rule.refine_stop_iter = min(rule.refine_stop_iter, step)
            rule.step_post_backward(model.splats, adam, state, step, info, packed=False)
    torch.cuda.synchronize(device)
    model.loop_seconds = time.perf_counter() - started
    return model


if __name__ == "__main__":
    tyro.cli(main)
