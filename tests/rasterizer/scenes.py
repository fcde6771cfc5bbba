"""Small random scenes and error measures for the splatting tests."""

from dataclasses import dataclass

import torch

from sehdr_warp.rasterizer.projection import ProjectedGaussians, Splats2D, project_to_camera
from sehdr_warp.rasterizer.render_options import RenderOptions
from sehdr_warp.rasterizer.tile_lists import PackedSplats, pack_splats

WIDTH, HEIGHT = 70, 50


@dataclass
class SplatInputs:
    """The tensor arguments of rasterize(), in its order."""

    tensors: list[torch.Tensor]
    width: int = WIDTH
    height: int = HEIGHT

    def to(self, dtype=None, device=None) -> "SplatInputs":
        moved = [t.detach().to(dtype=dtype, device=device).requires_grad_() for t in self.tensors]
        return SplatInputs(moved, self.width, self.height)

    @property
    def arguments(self):
        return (*self.tensors, self.width, self.height)


def random_scene(count=150, channels=3, seed=0, width=WIDTH, height=HEIGHT, spread=4.0, size=0.25) -> SplatInputs:
    """float64 Gaussians before a camera that is neither centered nor axis-aligned; some lie behind it or off the image.

    Features are log-normal over several decades, as radiance is.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = (uniform(count, 3) - 0.5) * torch.tensor([spread, spread, 5.0]) + torch.tensor([0.0, 0.0, 2.8])
    log_scales = torch.log(0.03 + size * uniform(count, 3))
    quaternions = normal(count, 4) * 3.0
    opacities = 0.05 + 0.94 * uniform(count)
    features = torch.exp(2.0 * normal(count, channels))
    angle = torch.tensor(0.1, dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = angle.cos()
    pose[0, 2], pose[2, 0] = angle.sin(), -angle.sin()
    pose[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    intrinsics = torch.tensor([60.0, 62.0, width / 2 + 3.0, height / 2 - 2.0], dtype=torch.float64)
    return SplatInputs([means, log_scales, quaternions, opacities, features, pose, intrinsics], width, height)


def projected(scene: SplatInputs, threshold: float = 1 / 255) -> ProjectedGaussians:
    """The 2D Gaussians of a scene, with no graph behind them."""
    options = RenderOptions(scene.width, scene.height, 0.01, 0.3, threshold)
    tensors = *scene.tensors[:4], *scene.tensors[5:]
    with torch.no_grad():
        return project_to_camera(*tensors, options)


def packed(scene: SplatInputs, threshold: float = 1 / 255) -> PackedSplats:
    gaussians = projected(scene, threshold)
    splats = Splats2D(*gaussians, gaussians.means2d.new_empty(len(gaussians.means2d), 0))
    return pack_splats(splats, threshold, scene.width, scene.height)


def relative_error(value: torch.Tensor, truth: torch.Tensor) -> float:
    """|value - truth| / |truth| over the whole tensor, in float64 (0 if both are 0)."""
    value, truth = value.detach().double().cpu(), truth.detach().double().cpu()
    return float((value - truth).norm() / truth.norm().clamp(min=1e-300))


def random_like(tensor: torch.Tensor, seed: int) -> torch.Tensor:
    """Normal numbers of the tensor's shape, dtype and device, the same for every dtype and device."""
    values = torch.randn(tensor.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return values.to(dtype=tensor.dtype, device=tensor.device)


def finite_differences(function, tensors, which: int, step: float = 1e-5) -> torch.Tensor:
    """The gradient of a scalar function by one of its float64 tensors, by fourth-order central differences."""
    tensors = [t.detach().clone() for t in tensors]
    flat = tensors[which].reshape(-1)
    gradient = torch.zeros_like(flat)
    with torch.no_grad():
        for k in range(flat.numel()):
            start = flat[k].item()
            values = []
            for offset in (-2, -1, 1, 2):
                flat[k] = start + offset * step
                values.append(float(function(*tensors)))
            flat[k] = start
            gradient[k] = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
    return gradient.reshape(tensors[which].shape)
