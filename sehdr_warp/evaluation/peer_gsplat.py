"""The plain 3DGS training done by gsplat 1.5 (Ye et al. 2025), for a comparison on equal terms.

Same photos, split, start points, start colours, losses and iteration count as the preset `3dgs`; gsplat's rasterization
and DefaultStrategy at 3DGS's settings. gsplat needs CUDA and is not a dependency.
"""

import time

import torch

from ..errors import SehdrError
from ..model.gaussians import Gaussians
from ..scene import Scene
from ..splatting.ssim import ssim
from ..training.initialization import scene_extent, start_colours
from .metrics import psnr


def train_with_gsplat(scene: Scene, iterations: int = 30_000, seed: int = 0, device: str = "cuda:0") -> dict:
    """Train on a scene's training views and measure the held-out ones.

    Returns {"psnr_ldr" dB over the test views, "train_seconds", "gaussians", "iterations"}.
    Raises SehdrError where gsplat is not installed or the scene has no points to start from.
    """
    try:
        from gsplat import DefaultStrategy, rasterization
    except ImportError as error:
        raise SehdrError(f"gsplat is not installed ({error}); pip install gsplat==1.5.3 on a machine with CUDA") from None
    if not len(scene.points):
        raise SehdrError(f"{scene.name} has no points; the comparison starts both sides from the same ones")
    torch.manual_seed(seed)
    extent = scene_extent(scene)
    start = Gaussians.from_points(
        torch.tensor(scene.points, dtype=torch.float32),
        torch.tensor(start_colours(scene.point_colors, "display", None), dtype=torch.float32),
        3,
    )
    values = {
        "means": (start.means, 1.6e-4 * extent),
        "scales": (start.log_scales, 5e-3),
        "quats": (start.quaternions, 1e-3),
        "opacities": (start.opacity_logits, 5e-2),
        "sh0": (start.harmonics_dc, 2.5e-3),
        "shN": (start.harmonics_rest, 2.5e-3 / 20),
    }
    params = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value.detach().to(device)) for name, (value, _) in values.items()}
    )
    optimizers = {
        name: torch.optim.Adam([{"params": params[name], "lr": rate, "name": name}], eps=1e-15, fused=True)
        for name, (_, rate) in values.items()
    }
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=0.01 ** (1.0 / iterations))
    strategy = DefaultStrategy(verbose=False)
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
        )
        return image[0], info

    order, generator = [], torch.Generator().manual_seed(seed)
    torch.cuda.synchronize()
    started = time.perf_counter()
    for step in range(iterations):
        order = order or torch.randperm(len(views), generator=generator).tolist()
        pose, intrinsics, photo = views[order.pop()]
        image, info = render(pose, intrinsics, photo.shape[1], photo.shape[0], min(step // 1000, 3))
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = 0.8 * (image - photo).abs().mean() + 0.2 * (1 - ssim(image, photo))
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        decay.step()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
    torch.cuda.synchronize()
    seconds = time.perf_counter() - started
    scores = []
    with torch.no_grad():
        for view in scene.test_views:
            pose, intrinsics, photo = _upload(view, device)
            image, _ = render(pose, intrinsics, photo.shape[1], photo.shape[0], 3)
            scores.append(psnr(image.clamp(0, 1), photo))
    return {
        "psnr_ldr": sum(scores) / max(1, len(scores)),
        "train_seconds": seconds,
        "gaussians": params["means"].shape[0],
        "iterations": iterations,
    }


def _upload(view, device):
    camera = view.camera
    intrinsics = torch.tensor(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=torch.float32, device=device
    )
    pose = torch.tensor(camera.world_to_camera, dtype=torch.float32, device=device)
    return pose, intrinsics, torch.tensor(view.image, device=device)
