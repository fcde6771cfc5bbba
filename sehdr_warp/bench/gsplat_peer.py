"""gsplat (Ye et al. 2025) beside us, where it is installed and there is a GPU: its rasterizer in our place, and plain
3DGS trained by its own strategy."""

import importlib.util
import time
from collections.abc import Callable

import torch

from ..errors import SehdrError
from ..evaluation.metrics import psnr
from ..field.color_models import color_model
from ..field.gaussians import Gaussians
from ..kernels.constants import LOW_PASS
from ..scene import Scene
from ..splatting import Rendering
from ..training.config import Config
from ..training.initialization import scene_extent
from ..training.losses import image_loss
from .splats import SplatScene
from .timing import wait

GSPLAT = "gsplat"
BOUND = 1e-3
"""Largest relative difference of its image, or of a step's loss with it, from ours."""


def note_missing(result: dict, device: torch.device) -> bool:
    """Whether gsplat can run here; a note in the result says why not."""
    if device.type != "cuda":
        result["notes"].append("gsplat not compared: it needs CUDA")
        return False
    if importlib.util.find_spec("gsplat") is None:
        result["notes"].append("gsplat not compared: not installed (pip install gsplat==1.5.3)")
        return False
    return True


def rasterize_with_gsplat(
    means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics, width: int, height: int, *,
    low_pass: float = LOW_PASS, antialiased: bool = False, capacity: int | None = None, deterministic: bool = False,
) -> Rendering:  # fmt: skip
    """rasterize() by gsplat. capacity and deterministic mean nothing there; there is no transmittance, and
    densification by gradients cannot watch its centers."""
    from gsplat import rasterization

    fx, fy, cx, cy = intrinsics
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    matrix = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).reshape(1, 3, 3)
    image, _, info = rasterization(
        means, quaternions, log_scales.exp(), opacities, features, world_to_camera[None], matrix, width, height,
        packed=False, rasterize_mode="antialiased" if antialiased else "classic", eps2d=low_pass,
    )  # fmt: skip
    # gsplat 1.5 gives two radii, its forerunners one.
    radii = info["radii"][0]
    radii = radii.amax(-1) if radii.ndim == 2 else radii
    return Rendering(image[0], None, info["means2d"][0], info["depths"][0], radii, 0)


def gsplat_renderer(scene: SplatScene) -> Callable[[], torch.Tensor]:
    """A function that renders [H, W, C]; what does not change between calls is prepared."""
    from gsplat import rasterization

    means, log_scales, quaternions, opacities, features = scene.leaves
    fx, fy, cx, cy = scene.intrinsics.tolist()
    intrinsics = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], device=scene.device)
    camera = scene.world_to_camera[None], intrinsics, scene.size.width, scene.size.height

    def render():
        given = means, quaternions, log_scales.exp(), opacities, features, *camera
        return rasterization(*given, packed=False)[0][0]

    return render


def train_with_gsplat(scene: Scene, config: Config, device: torch.device, *, steps: int | None = None) -> dict:
    """Plain 3DGS by gsplat's rasterization and DefaultStrategy on the photos, split, start, losses and rates that a
    config of the preset `3dgs` has for ours.

    Opacities are reset every densification.reset_every iterations, as 3DGS does: gsplat 1.5.3 as released never does
    (its condition is `step % reset_every == 0 & step > 0`, and & binds before the comparisons).

    Args:
        config: iteration numbers are scaled to its length. steps: stop after so many iterations, to warm up.

    Raises:
        SehdrError: where the scene has no points to start from.
    """
    from gsplat import DefaultStrategy, rasterization
    from gsplat.strategy.ops import reset_opa

    if not len(scene.points):
        raise SehdrError(f"{scene.name} has no points; the comparison starts both sides from the same ones")
    torch.manual_seed(config.seed)
    densification, rates, schedule = config.densification, config.optimizer, config.schedule
    start = Gaussians.from_points(
        torch.tensor(scene.points, dtype=torch.float32),
        torch.tensor(color_model("display").start(scene.point_colors, None), dtype=torch.float32),
        config.model.harmonics_degree,
    )
    extent = scene_extent(scene)
    values = {
        "means": (start.means, rates.means * extent),
        "scales": (start.log_scales, rates.log_scales),
        "quats": (start.quaternions, rates.quaternions),
        "opacities": (start.opacity_logits, rates.opacity_logits),
        "sh0": (start.harmonics_dc, rates.harmonics_dc),
        "shN": (start.harmonics_rest, rates.harmonics_rest),
    }
    leaves = {name: torch.nn.Parameter(value.detach().to(device)) for name, (value, _) in values.items()}
    params = torch.nn.ParameterDict(leaves)
    optimizers = {
        name: torch.optim.Adam([{"params": params[name], "lr": rate, "name": name}], eps=1e-15, fused=True)
        for name, (_, rate) in values.items()
    }
    gamma = (rates.means_final / rates.means) ** (1.0 / schedule.iterations)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=gamma)
    stop, reset_every = config.scaled(densification.stop), config.scaled(densification.reset_every)
    strategy = DefaultStrategy(
        prune_opa=densification.prune_opacity, grow_grad2d=densification.grow_gradient,
        grow_scale3d=densification.grow_scale, prune_scale3d=densification.prune_scale,
        refine_start_iter=config.scaled(densification.start), refine_stop_iter=stop,
        refine_every=config.scaled(densification.every), reset_every=reset_every, verbose=False,
    )  # fmt: skip
    state = strategy.initialize_state(scene_scale=extent)

    def render(view, degree):
        image, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
            torch.cat([params["sh0"], params["shN"]], 1), *view.camera, sh_degree=degree, packed=False, eps2d=LOW_PASS,
        )  # fmt: skip
        return image[0], info

    views = [_Uploaded(view, device) for view in scene.train_views]
    order, generator = [], torch.Generator().manual_seed(config.seed)
    wait(device)
    started = time.perf_counter()
    for step in range(steps or schedule.iterations):
        order = order or torch.randperm(len(views), generator=generator).tolist()
        view = views[order.pop()]
        degree = min(step // config.scaled(schedule.harmonics_every), config.model.harmonics_degree)
        image, info = render(view, degree)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        image_loss(image, view.photo, view.mask, config.loss.form, config.loss.ssim_weight).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        decay.step()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
        if 0 < step < stop and step % reset_every == 0:
            reset_opa(params, optimizers, state, value=2 * densification.prune_opacity)
    wait(device)
    seconds = time.perf_counter() - started
    scores = []
    with torch.no_grad():
        for view in (_Uploaded(view, device) for view in scene.test_views):
            mask = None if view.mask is None else view.mask[..., 0]
            scores.append(psnr(render(view, degree)[0].clamp(0, 1), view.photo, mask))
    return {
        "psnr_ldr": sum(scores) / len(scores) if scores else None,
        "train_seconds": seconds,
        "gaussians": params["means"].shape[0],
        "peak_memory_bytes": torch.cuda.max_memory_allocated(device),
    }


class _Uploaded:
    """A view on a device: photo [H, W, 3], mask [H, W, 1] or None, and the camera as gsplat takes it."""

    def __init__(self, view, device):
        def upload(value):
            return torch.tensor(value, dtype=torch.float32, device=device)

        camera = view.camera
        matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        self.camera = upload(camera.world_to_camera)[None], upload(matrix)[None], camera.width, camera.height
        self.photo = upload(view.image)
        self.mask = None if view.mask is None else upload(view.mask)[..., None]
