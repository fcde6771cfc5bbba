"""Synthetic splats: Gaussians that fill an image at a density like that of a trained scene, at any count and size."""

import math
import re
from dataclasses import dataclass

import torch

from ..errors import SehdrError

NAMES = ("means", "log_scales", "quaternions", "opacities", "features")


@dataclass(frozen=True)
class Size:
    """How many Gaussians on how many pixels."""

    gaussians: int
    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.gaussians}@{self.width}x{self.height}"

    def reduced(self, most_gaussians: int) -> "Size":
        """The same density of Gaussians, at most so many of them (but an image of at least 16 pixels a side)."""
        shrink = math.sqrt(max(1.0, self.gaussians / most_gaussians))
        sides = (max(16, round(side / shrink)) for side in (self.width, self.height))
        return Size(max(1, round(self.gaussians / shrink**2)), *sides)


SIZES = {
    "cuda": {
        "small": Size(50_000, 400, 400),
        "medium": Size(200_000, 800, 800),
        "large": Size(1_000_000, 1600, 1200),
    },
    "cpu": {
        "small": Size(5_000, 200, 200),
        "medium": Size(20_000, 200, 200),
        "large": Size(50_000, 400, 400),
    },
}
DEFAULT_SIZES = {"cuda": "small,medium,large", "cpu": "small,medium"}


def parse_sizes(text: str | None, device_type: str) -> list[Size]:
    """Sizes from `small,medium` or `20000@200x200,1M@1600x1200`; None means the device's default. Raises SehdrError."""
    return [parse_size(item.strip(), device_type) for item in (text or DEFAULT_SIZES[device_type]).split(",")]


def parse_size(text: str, device_type: str) -> Size:
    """One size: a name of SIZES, or Gaussians@WIDTHxHEIGHT, where k and M multiply. Raises SehdrError."""
    if text in SIZES[device_type]:
        return SIZES[device_type][text]
    match = re.fullmatch(r"(\d+)([kM]?)@(\d+)x(\d+)", text)
    if match:
        count = int(match[1]) * {"": 1, "k": 1000, "M": 1_000_000}[match[2]]
        if count and int(match[3]) and int(match[4]):
            return Size(count, int(match[3]), int(match[4]))
    raise SehdrError(f"size {text}: not a size; use small, medium, large or Gaussians@WIDTHxHEIGHT such as 20k@200x200")


@dataclass(frozen=True)
class SplatScene:
    """The arguments of rasterize(): five tensors to differentiate (in the order of NAMES), camera, image size."""

    leaves: tuple[torch.Tensor, ...]
    world_to_camera: torch.Tensor
    intrinsics: torch.Tensor
    size: Size

    @property
    def arguments(self) -> tuple:
        """What rasterize() takes positionally."""
        return (*self.leaves, self.world_to_camera, self.intrinsics, self.size.width, self.size.height)

    @property
    def channels(self) -> int:
        return self.leaves[-1].shape[1]

    @property
    def device(self) -> torch.device:
        return self.leaves[0].device

    def to(self, device=None, dtype=None) -> "SplatScene":
        """A copy with leaves of its own, which ask for gradients."""
        leaves = tuple(leaf.detach().to(device, dtype, copy=True).requires_grad_() for leaf in self.leaves)
        camera = (tensor.to(device, dtype) for tensor in (self.world_to_camera, self.intrinsics))
        return SplatScene(leaves, *camera, self.size)

    def clear(self) -> None:
        """Forget the gradients."""
        for leaf in self.leaves:
            leaf.grad = None

    def cotangent(self) -> torch.Tensor:
        """[H, W, C] in [0, 1), the gradient that a loss would send back; the same on every device and dtype."""
        generator = torch.Generator().manual_seed(1)
        values = torch.rand(self.size.height, self.size.width, self.channels, generator=generator)
        return values.to(self.leaves[0])


def make_splat_scene(size: Size, channels: int, seed: int = 0) -> SplatScene:
    """float32 Gaussians on the CPU before a centred pinhole camera at the origin.

    Depths 2 to 8; centres spread over the image and 5 % beyond its borders; standard deviations in pixels follow the
    mean distance between centres, most of them small, so that the depth of layers does not depend on the size.
    """
    generator = torch.Generator().manual_seed(seed)
    count, width, height = size.gaussians, size.width, size.height

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    focal = 0.8 * width
    depth = 2 + 6 * uniform(count)
    across = torch.stack([(uniform(count) - 0.5) * 1.1 * side / focal for side in (width, height)], dim=1)
    means = torch.cat([across * depth[:, None], depth[:, None]], dim=1)
    spacing = math.sqrt(width * height / (1.2 * count))
    deviation = 0.5 * spacing * (0.6 + 2.4 * uniform(count) ** 2)
    log_scales = torch.log((deviation * depth / focal)[:, None] * (0.4 + 1.2 * uniform(count, 3)))
    quaternions = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
    opacities = 0.05 + 0.9 * uniform(count) ** 1.5
    leaves = (means, log_scales, quaternions, opacities, uniform(count, channels))
    intrinsics = torch.tensor([focal, focal, width / 2, height / 2])
    return SplatScene(leaves, torch.eye(4), intrinsics, size).to()
