"""Other rasterizers on the same splats: used where they import and the device is one they run on, said so otherwise."""

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from .machine import package_version
from .splats import SplatScene


@dataclass(frozen=True)
class Peer:
    """Another implementation of rasterize().

    renderer(scene) prepares what does not change and returns a function of no arguments that renders [H, W, C],
    differentiable in the scene's leaves. channels: the channel counts it has, None for any.
    bound: largest relative difference of its image, or of a step's loss with it, from ours; beyond, it does other work
        than we do.
    """

    name: str
    version: str | None
    renderer: Callable[[SplatScene], Callable[[], torch.Tensor]]
    channels: tuple[int, ...] | None
    bound: float

    def supports(self, channels: int) -> bool:
        return self.channels is None or channels in self.channels


def find_peers(device: torch.device) -> tuple[list[Peer], list[str]]:
    """The peers that can run here, and one line for each that cannot."""
    known = {
        "gsplat": (_gsplat_renderer, None, 1e-3),
        # 3DGS's cut at three standard deviations leaves out up to 1 % of a splat's height.
        "gswarp": (_gswarp_renderer, (3,), 2e-2),
    }
    found, notes = [], []
    for name, (renderer, channels, bound) in known.items():
        if device.type != "cuda":
            notes.append(f"{name} not compared: it needs CUDA")
            continue
        try:
            importlib.import_module(name)
        except (ImportError, OSError, RuntimeError) as error:  # a broken build raises any of them
            notes.append(f"{name} not compared: cannot be imported ({type(error).__name__}: {error})")
            continue
        found.append(Peer(name, package_version(name), renderer, channels, bound))
    return found, notes


def _gsplat_renderer(scene: SplatScene) -> Callable[[], torch.Tensor]:
    from gsplat import rasterization

    means, log_scales, quaternions, opacities, features = scene.leaves
    fx, fy, cx, cy = scene.intrinsics.tolist()
    intrinsics = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], device=scene.device)
    pose, size = scene.world_to_camera[None], scene.size

    def render():
        image, _, _ = rasterization(
            means, quaternions, log_scales.exp(), opacities, features, pose, intrinsics, size.width, size.height,
            packed=False,
        )  # fmt: skip
        return image[0]

    return render


def _gswarp_renderer(scene: SplatScene) -> Callable[[], torch.Tensor]:
    from gswarp import GaussianRasterizationSettings, GaussianRasterizer

    means, log_scales, quaternions, opacities, features = scene.leaves
    size, (fx, fy, cx, cy) = scene.size, scene.intrinsics.tolist()
    if (cx, cy) != (size.width / 2, size.height / 2):
        raise ValueError("3DGS's camera has its principal point in the image's middle")
    near, far = 0.01, 100.0
    # 3DGS's projection, as it stores matrices: transposed, for row vectors.
    projection = torch.zeros(4, 4, device=scene.device)
    projection[0, 0], projection[1, 1] = 2 * fx / size.width, 2 * fy / size.height
    projection[2, 2], projection[3, 2], projection[2, 3] = far / (far - near), -far * near / (far - near), 1.0
    view = scene.world_to_camera.T.contiguous()
    rasterizer = GaussianRasterizer(
        GaussianRasterizationSettings(
            image_height=size.height,
            image_width=size.width,
            tanfovx=size.width / (2 * fx),
            tanfovy=size.height / (2 * fy),
            bg=torch.zeros(3, device=scene.device),
            scale_modifier=1.0,
            viewmatrix=view,
            projmatrix=view @ projection,
            sh_degree=0,
            campos=torch.linalg.inv(scene.world_to_camera)[:3, 3].contiguous(),
            prefiltered=False,
            auto_tune_verbose=False,
        )
    )
    centres = torch.zeros_like(means).requires_grad_()

    def render():
        image, _, _ = rasterizer(
            means3D=means, means2D=centres, opacities=opacities[:, None], colors_precomp=features,
            scales=log_scales.exp(), rotations=quaternions,
        )  # fmt: skip
        return image.permute(1, 2, 0)

    return render


def differs(image: torch.Tensor, other: torch.Tensor) -> float:
    """|image - other| / |other| over the whole tensor, in float64; infinite where a number is not finite."""
    image, other = image.detach().double().cpu(), other.detach().double().cpu()
    difference = float((image - other).norm() / other.norm().clamp_min(1e-300))
    return difference if math.isfinite(difference) else math.inf
