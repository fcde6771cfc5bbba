"""The plain 3DGS training done by gsplat 1.5 (Ye et al. 2025), for a comparison on equal terms.

Same photos, split, start points, start colours, losses and iteration count as the preset `3dgs`; gsplat's rasterization
and DefaultStrategy at 3DGS's settings. gsplat needs CUDA and is not a dependency.
"""

import time

import torch

from ..errors import SehdrError
from ..evaluation.metrics import psnr
from ..field.gaussians import Gaussians
from ..kernels.constants import LOW_PASS
from ..scene import Scene
from ..splatting import Rendering
from ..training.config import Config
from ..training.heldout import BEST
from ..training.initialization import scene_extent, start_colours
from ..training.losses import image_loss


def train_with_gsplat(
    scene: Scene,
    config: Config,
    device: str | torch.device = "cuda:0",
    *,
    resets: bool = True,
    steps: int | None = None,
) -> dict:
    """Train on a scene's training views as a config of the preset `3dgs` says and measure the held-out ones.

    config: iterations, thresholds, losses and learning rates are taken from it.
    resets: reset the opacities every densification.reset_every iterations, as 3DGS does. gsplat 1.5.3 as released
        never does: its condition is `step % reset_every == 0 & step > 0`, and & binds before the comparisons.
    steps: stop after so many iterations, to warm up.

    Returns {"psnr_ldr" dB over the test views, "train_seconds", "gaussians", "iterations", "peak_gpu_memory_bytes"
    since torch's last reset}.
    Raises SehdrError where gsplat is not installed or the scene has no points to start from.
    """
    try:
        from gsplat import DefaultStrategy, rasterization
        from gsplat.strategy.ops import reset_opa
    except ImportError as error:
        raise SehdrError(
            f"gsplat is not installed ({error}); pip install gsplat==1.5.3 on a machine with CUDA"
        ) from None
    if not len(scene.points):
        raise SehdrError(f"{scene.name} has no points; the comparison starts both sides from the same ones")
    torch.manual_seed(config.seed)
    densification, rates, schedule = config.densification, config.optimizer, config.schedule
    extent = scene_extent(scene)
    start = Gaussians.from_points(
        torch.tensor(scene.points, dtype=torch.float32),
        torch.tensor(start_colours(scene.point_colors, "display", None), dtype=torch.float32),
        config.model.harmonics_degree,
    )
    values = {
        "means": (start.means, rates.means * extent),
        "scales": (start.log_scales, rates.log_scales),
        "quats": (start.quaternions, rates.quaternions),
        "opacities": (start.opacity_logits, rates.opacity_logits),
        "sh0": (start.harmonics_dc, rates.harmonics_dc),
        "shN": (start.harmonics_rest, rates.harmonics_rest),
    }
    params = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value.detach().to(device)) for name, (value, _) in values.items()}
    )
    optimizers = {
        name: torch.optim.Adam([{"params": params[name], "lr": rate, "name": name}], eps=1e-15, fused=True)
        for name, (_, rate) in values.items()
    }
    gamma = (rates.means_final / rates.means) ** (1.0 / schedule.iterations)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=gamma)
    strategy = DefaultStrategy(
        prune_opa=densification.prune_opacity,
        grow_grad2d=densification.grow_gradient,
        grow_scale3d=densification.grow_scale,
        prune_scale3d=densification.prune_scale,
        refine_start_iter=config.scaled(densification.start),
        refine_stop_iter=config.scaled(densification.stop),
        refine_every=config.scaled(densification.every),
        reset_every=config.scaled(densification.reset_every),
        verbose=False,
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=extent)
    views = [_upload(view, device) for view in scene.train_views]

    def render(pose, intrinsics, width, height, degree):
        image, _, info = rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            torch.cat([params["sh0"], params["shN"]], 1),
            pose[None],
            intrinsics[None],
            width,
            height,
            sh_degree=degree,
            packed=False,
            rasterize_mode="antialiased" if config.model.antialiased else "classic",
            eps2d=LOW_PASS,
        )
        return image[0], info

    harmonics_every = config.scaled(schedule.harmonics_every)
    order, generator = [], torch.Generator().manual_seed(config.seed)
    iterations = steps or schedule.iterations
    torch.cuda.synchronize(device)
    started = time.perf_counter()
    for step in range(iterations):
        order = order or torch.randperm(len(views), generator=generator).tolist()
        pose, intrinsics, photo, mask = views[order.pop()]
        degree = min(step // harmonics_every, config.model.harmonics_degree)
        image, info = render(pose, intrinsics, photo.shape[1], photo.shape[0], degree)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = image_loss(image, photo, mask, config.loss.form, config.loss.ssim_weight)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        decay.step()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
        if resets and 0 < step < strategy.refine_stop_iter and step % strategy.reset_every == 0:
            reset_opa(params, optimizers, state, value=2 * densification.prune_opacity)
    torch.cuda.synchronize(device)
    seconds = time.perf_counter() - started
    scores = []
    with torch.no_grad():
        for view in scene.test_views:
            pose, intrinsics, photo, mask = _upload(view, device)
            image, _ = render(pose, intrinsics, photo.shape[1], photo.shape[0], degree)
            scores.append(min(psnr(image.clamp(0, 1), photo, None if mask is None else mask[..., 0]), BEST))
    return {
        "psnr_ldr": sum(scores) / len(scores) if scores else None,
        "train_seconds": seconds,
        "gaussians": params["means"].shape[0],
        "iterations": iterations,
        "peak_gpu_memory_bytes": torch.cuda.max_memory_allocated(device),
    }


def _upload(view, device):
    """Pose [4, 4], intrinsics [3, 3], photo [H, W, 3] and mask [H, W, 1] or None of a view."""
    camera = view.camera
    intrinsics = torch.tensor(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=torch.float32, device=device
    )
    pose = torch.tensor(camera.world_to_camera, dtype=torch.float32, device=device)
    mask = None if view.mask is None else torch.tensor(view.mask, dtype=torch.float32, device=device)[..., None]
    return pose, intrinsics, torch.tensor(view.image, device=device), mask


def rasterize_with_gsplat(
    means,
    log_scales,
    quaternions,
    opacities,
    features,
    world_to_camera,
    intrinsics,
    width: int,
    height: int,
    *,
    low_pass: float = LOW_PASS,
    antialiased: bool = False,
    capacity: int | None = None,
    style: object = None,
) -> Rendering:
    """rasterize() by gsplat, for a training step of ours on its kernels. capacity, style: have no meaning there. Its
    centres in the image are not those that the gradient passes, so densification cannot watch them. There is no
    transmittance: a step reads none, and one more image would count as gsplat's memory."""
    from gsplat import rasterization

    fx, fy, cx, cy = intrinsics
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    matrix = torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).reshape(1, 3, 3)
    image, _, info = rasterization(
        means,
        quaternions,
        log_scales.exp(),
        opacities,
        features,
        world_to_camera[None],
        matrix,
        width,
        height,
        packed=False,
        rasterize_mode="antialiased" if antialiased else "classic",
        eps2d=low_pass,
    )
    # gsplat 1.5 gives two radii, its forerunners one.
    radii = info["radii"][0]
    radii = radii.amax(-1) if radii.ndim == 2 else radii
    means2d, depths = info["means2d"][0], info["depths"][0]
    return Rendering(image[0], None, means2d, depths, radii, 0)


def spherical_harmonics_with_gsplat(degree: int, coefficients, means, camera_position):
    """spherical_harmonics() by gsplat, which takes directions, and all coefficients in one tensor."""
    from gsplat import spherical_harmonics

    joined = coefficients if isinstance(coefficients, torch.Tensor) else torch.cat(coefficients, dim=1)
    return spherical_harmonics(degree, means - camera_position, joined)
