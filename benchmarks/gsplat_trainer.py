"""gsplat 1.5.3 trained as its examples/simple_trainer.py trains: schedule, rates, start and densification are its own.

The scene must be in normalized coordinates, as that trainer's `normalize_world_space` gives them. Written anew from its
documented options; needs `pip install gsplat` and CUDA.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.rasterizer.losses.ssim import image_distance
from sehdr_warp.scene import Camera, Scene
from sehdr_warp.training.initialization import random_points

STEPS = 30_000  # simple_trainer.py's max_steps
CAP_MAX = 1_000_000  # MCMCStrategy.cap_max
SCENE_SCALE = 1.1  # Camera radius of a normalized scene times the trainer's margin
SH_INTERVAL = 1000
FEWEST_POINTS = 1000  # With fewer sparse points the trainer's init_type "random" takes this many times 100
STRATEGIES = ("default", "mcmc")


@dataclass(frozen=True)
class Snapshot:
    """Step of a training, and its seconds until then."""

    step: int
    seconds: float


class GsplatScene:
    """Gaussians as gsplat's examples hold them, and their render."""

    def __init__(self, start: Gaussians, device: str) -> None:
        """Take over Gaussians whose colors are display colors."""
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

    @property
    def count(self) -> int:
        """The number of Gaussians."""
        return len(self.splats["means"])

    def render(self, camera: Camera, degree: int = 3) -> tuple[Tensor, dict]:
        """Return an image [H, W, 3], encoded, and gsplat's intermediate results."""
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]

        s = self.splats
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        image, _, info = rasterization(
            means=s["means"],
            quats=s["quats"],
            scales=s["scales"].exp(),
            opacities=s["opacities"].sigmoid(),
            colors=torch.cat([s["sh0"], s["shN"]], 1),
            viewmats=torch.tensor(camera.world_to_camera[None], dtype=torch.float32, device=self.device),
            Ks=torch.tensor([matrix], dtype=torch.float32, device=self.device),
            width=camera.width,
            height=camera.height,
            sh_degree=degree,
            packed=False,
        )
        return image[0], info


def start_of(scene: Scene, strategy: str, seed: int, fewest_points: int = FEWEST_POINTS) -> Gaussians:
    """Return the Gaussians that the trainer starts from: the sparse points, or random ones where there are too few."""
    points, colors = scene.points, scene.point_colors
    if len(points) < fewest_points:
        points, colors = random_points(scene, 100 * FEWEST_POINTS, np.random.default_rng(seed))
    points, colors = (torch.tensor(values, dtype=torch.float32) for values in (points, colors))
    opacity, scale = (0.5, 0.1) if strategy == "mcmc" else (0.1, 1.0)
    return Gaussians.from_points(points, colors - 0.5, 3, opacity=opacity, scale=scale)


def train_gsplat(
    scene: Scene,
    strategy: str,
    device: str,
    *,
    seed: int = 0,
    steps: int = STEPS,
    cap_max: int = CAP_MAX,
    fewest_points: int = FEWEST_POINTS,
    look_at: Sequence[int] = (),
    look: Callable[[GsplatScene, Snapshot], None] = lambda model, snapshot: None,
) -> GsplatScene:
    """Train on the training views of a scene in normalized coordinates.

    Args:
        scene: with its masks, whose pixels outside are left out of the loss.
        strategy: "default" or "mcmc".
        device: a CUDA device.
        seed: of torch and of random start points.
        steps: of the training; other step numbers scale with it, as by the trainer's steps_scaler.
        cap_max: the count that "mcmc" grows to.
        fewest_points: with fewer sparse points it starts from random ones.
        look_at: steps after which `look` is called with the scene; the time that it takes does not count.
        look: see look_at.

    Returns:
        The trained scene.
    """
    from gsplat import DefaultStrategy, MCMCStrategy  # pyright: ignore[reportMissingImports]

    torch.manual_seed(seed)
    model = GsplatScene(start_of(scene, strategy, seed, fewest_points), device)

    def scaled(step: int) -> int:
        return max(1, int(step * steps / STEPS))

    rates = {"means": 1.6e-4 * SCENE_SCALE, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3}
    rates["shN"] = rates["sh0"] / 20
    adam = {k: torch.optim.Adam([model.splats[k]], lr=rate, eps=1e-15, fused=True) for k, rate in rates.items()}
    decay = torch.optim.lr_scheduler.ExponentialLR(adam["means"], gamma=0.01 ** (1 / steps))
    intervals = {"refine_start_iter": scaled(500), "refine_every": scaled(100)}
    if strategy == "mcmc":
        rule = MCMCStrategy(cap_max=cap_max, refine_stop_iter=scaled(25_000), **intervals)
        state = rule.initialize_state()
    else:
        rule = DefaultStrategy(refine_stop_iter=scaled(15_000), reset_every=scaled(3000), **intervals)
        state = rule.initialize_state(scene_scale=SCENE_SCALE)
    rule.check_sanity(model.splats, adam)
    views = scene.train_views
    codes = [torch.tensor(view.codes, device=device) for view in views]
    masks = [None if view.mask is None else torch.tensor(view.mask, device=device)[..., None] for view in views]
    order, seconds, started = [], 0.0, time.perf_counter()
    for step in range(steps):
        if not order:
            order = torch.randperm(len(views)).tolist()
        index = order.pop()
        photo, mask = codes[index].float() / views[index].levels, masks[index]
        image, info = model.render(views[index].camera, min(step // scaled(SH_INTERVAL), 3))
        if strategy == "default":
            rule.step_pre_backward(model.splats, adam, state, step, info)
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
            rule.step_post_backward(model.splats, adam, state, step, info, packed=False)
        if step + 1 in look_at:
            torch.cuda.synchronize(device)
            seconds += time.perf_counter() - started
            look(model, Snapshot(step + 1, seconds))
            started = time.perf_counter()
    return model
