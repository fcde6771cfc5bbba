"""Gaussians for the splat's cases, and the splat in float64 with disturbed interfaces."""

import torch
from torch import Tensor

from ..kernels.constants import ALPHA_THRESHOLD, LOW_PASS, NEAR
from ..splatting import rasterize
from ..splatting.reference import blend_reference, project_reference
from .case import Reading, as_float32, compare

NAMES = ("means", "log_scales", "quaternions", "opacities", "features", "world_to_camera", "intrinsics")
GRADIENTS = NAMES[:5]


class Splats:
    """Arguments of rasterize() in float64, to be changed by a case; tensors by the names of rasterize()."""

    def __init__(self, count: int = 40, width: int = 40, height: int = 30, seed: int = 0, spread: float = 2.0):
        generator = torch.Generator().manual_seed(seed)

        def uniform(*shape):
            return torch.rand(*shape, generator=generator, dtype=torch.float64)

        def normal(*shape):
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        self.width, self.height = width, height
        self.means = (uniform(count, 3) - 0.5) * torch.tensor([spread, spread, 2.0]) + torch.tensor([0.0, 0.0, 3.0])
        self.log_scales = torch.log(0.05 + 0.25 * uniform(count, 3))
        self.quaternions = normal(count, 4)
        self.opacities = 0.05 + 0.9 * uniform(count)
        self.features = torch.exp(normal(count, 3))
        self.world_to_camera = torch.eye(4, dtype=torch.float64)
        focal = 0.9 * max(width, height)
        self.intrinsics = torch.tensor([focal, focal, width / 2 + 0.3, height / 2 - 0.2], dtype=torch.float64)
        self.options: dict = {}

    @property
    def tensors(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name in NAMES}

    def float32(self, device) -> list[Tensor]:
        return [tensor.to(device, torch.float32) for tensor in self.tensors.values()]


def compare_splat(splats: Splats, device: torch.device, *, ties: bool = False, **options) -> list[Reading]:
    """Image, alpha and gradients of rasterize() against the float64 reference.

    ties: depths are equal, and their order is by index: they are not disturbed. options: as compare() takes them.
    """
    width, height = splats.width, splats.height
    given = {"near": NEAR, "low_pass": LOW_PASS, "alpha_threshold": ALPHA_THRESHOLD, "antialiased": False}
    given |= splats.options

    def ours(*tensors):
        rendering = rasterize(*tensors, width, height, **given)
        return {"image": rendering.image, "alpha": rendering.alpha}

    exact_depths = project_reference(
        *as_float32(list(splats.tensors.values()))[:4], *as_float32([splats.world_to_camera, splats.intrinsics]), width,
        height, *given.values(),
    )[2]  # fmt: skip

    def truth(disturb, means, log_scales, quaternions, opacities, features, pose, intrinsics):
        means2d, conics, depths, opacities2d, extents = project_reference(
            means, log_scales, quaternions, opacities, pose, intrinsics, width, height, *given.values()
        )
        image, transmittance = blend_reference(
            disturb(means2d),
            disturb(conics),
            disturb(opacities2d),
            features,
            exact_depths if ties else disturb(depths.detach()),
            extents,
            width,
            height,
            given["alpha_threshold"],
        )
        return {"image": image, "alpha": 1.0 - transmittance}

    return compare(ours, truth, splats.tensors, device, gradients=GRADIENTS, **options)
