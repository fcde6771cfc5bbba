"""Scenes to measure on: random Gaussians before a camera, and photos of a synthetic scene, at any count and size."""

import math
import re
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera, Scene, View, codes_of, look_at

NAMES = ("means", "log_scales", "quaternions", "opacities", "features")
EXPOSURE_TIME, BALLS = 0.25, 24


@dataclass(frozen=True)
class Size:
    """Number of Gaussians, and size of the image."""

    gaussians: int
    width: int
    height: int

    def __str__(self) -> str:
        """Return such as `100000@640x480`."""
        return f"{self.gaussians}@{self.width}x{self.height}"

    def reduced(self, most: int) -> "Size":
        """Return the size of the same density with at most `most` Gaussians; sides keep 16 pixels."""
        shrink = math.sqrt(max(1.0, self.gaussians / most))
        width, height = (max(16, round(side / shrink)) for side in (self.width, self.height))
        return Size(max(1, round(self.gaussians / shrink**2)), width, height)


def parse_size(text: str) -> Size:
    """`20k@200x200`, where k and M multiply. Raises SehdrError."""
    number = r"0*([1-9]\d*)"
    match = re.fullmatch(rf"{number}([kM]?)@{number}x{number}", text.strip())
    if not match:
        raise SehdrError(f"size {text}: not a size; write Gaussians@WIDTHxHEIGHT such as 20k@200x200")
    return Size(int(match[1]) * {"": 1, "k": 1000, "M": 1_000_000}[match[2]], int(match[3]), int(match[4]))


@dataclass(frozen=True)
class SplatScene:
    """The arguments of rasterize(): five tensors to differentiate (in the order of NAMES), camera, image size."""

    leaves: tuple[torch.Tensor, ...]
    world_to_camera: torch.Tensor
    intrinsics: torch.Tensor
    size: Size

    @property
    def arguments(self) -> tuple:
        """The arguments of rasterize()."""
        return (*self.leaves, self.world_to_camera, self.intrinsics, self.size.width, self.size.height)

    @property
    def channels(self) -> int:
        """Channels of the features."""
        return self.leaves[-1].shape[1]

    @property
    def device(self) -> torch.device:
        """The device of all tensors."""
        return self.leaves[0].device

    def to(self, device=None, dtype=None) -> "SplatScene":
        """Return a copy with leaves of its own, which require gradients."""
        leaves = tuple(leaf.detach().to(device, dtype, copy=True).requires_grad_() for leaf in self.leaves)
        return SplatScene(leaves, self.world_to_camera.to(device, dtype), self.intrinsics.to(device, dtype), self.size)

    def clear(self) -> None:
        """Forget the gradients of the leaves."""
        for leaf in self.leaves:
            leaf.grad = None

    def cotangent(self) -> torch.Tensor:
        """[H, W, C] in [0, 1), the gradient that a loss would send back; alike on every device and in every dtype."""
        generator = torch.Generator().manual_seed(1)
        shape = self.size.height, self.size.width, self.channels
        return torch.rand(shape, generator=generator).to(self.leaves[0])


def make_splat_scene(size: Size, channels: int, device: torch.device | str = "cpu") -> SplatScene:
    """Make float32 Gaussians at depths of 2 to 8 before a centered pinhole camera at the origin.

    Deviations follow the mean distance between centers, so that any size has some 15 layers over the alpha threshold in
    a pixel.
    """
    generator = torch.Generator().manual_seed(0)
    uniform = partial(torch.rand, generator=generator)
    count, width, height, focal = size.gaussians, size.width, size.height, 0.8 * size.width
    depth = 2 + 6 * uniform(count)
    across = torch.stack([(uniform(count) - 0.5) * 1.1 * side / focal for side in (width, height)], dim=1)
    means = torch.cat([across * depth[:, None], depth[:, None]], dim=1)
    deviation = 0.5 * math.sqrt(width * height / (1.2 * count)) * (0.6 + 2.4 * uniform(count) ** 2)
    log_scales = torch.log((deviation * depth / focal)[:, None] * (0.4 + 1.2 * uniform(count, 3)))
    quaternions = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
    leaves = (means, log_scales, quaternions, 0.05 + 0.9 * uniform(count) ** 1.5, uniform(count, channels))
    intrinsics = torch.tensor([focal, focal, width / 2, height / 2])
    return SplatScene(leaves, torch.eye(4), intrinsics, size).to(device)


def make_photo_scene(size: Size, views: int = 18, device: str | torch.device = "cpu") -> Scene:
    """Render 8-bit sRGB photos, all for training, of colored balls on a floor, from a circle around them.

    size.gaussians points lie on the surfaces. device: where the photos are rendered.
    """
    rng = np.random.default_rng(0)
    points, log_exposure = _surfaces(size.gaussians, rng)
    response = response_by_name("srgb")
    points32, colors32 = (torch.tensor(x, dtype=torch.float32, device=device) for x in (points, log_exposure))
    gaussians = Gaussians.from_points(points32, colors32, 0, opacity=0.9)
    field = RadianceField(gaussians, response, base_time=EXPOSURE_TIME)
    photos = []
    for index in range(views):
        angle, focal = 2 * np.pi * index / views, 1.1 * size.width
        # From a circle at height 1.6, towards the middle of the balls.
        pose = look_at([3.5 * np.cos(angle), 3.5 * np.sin(angle), 1.6], (0.0, 0.0, 0.4))
        camera = Camera(size.width, size.height, focal, focal, size.width / 2, size.height / 2, pose)
        codes = codes_of(field.render_ldr(camera).cpu().numpy(), 8)
        photos.append(View(f"v_{index}", codes, camera, EXPOSURE_TIME, "train"))
    colors = np.asarray(response.encode(np.exp(log_exposure)), dtype=np.float32)
    return Scene(f"synthetic {size}", "transforms", tuple(photos), points, colors)


def _surfaces(count: int, rng) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] on balls and on the floor z = 0, and their log exposures [N, 3] over some six stops."""
    centers = np.concatenate([rng.uniform(-1.2, 1.2, (BALLS, 2)), rng.uniform(0.2, 1.0, (BALLS, 1))], axis=1)
    radii, tints = rng.uniform(0.1, 0.35, BALLS), rng.uniform(-3.5, 0.5, (BALLS + 1, 3))
    which = rng.integers(0, BALLS + 8, count).clip(max=BALLS)
    on_floor = which == BALLS
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ball = np.where(on_floor, 0, which)
    points = centers[ball] + radii[ball, None] * direction
    points[on_floor] = np.concatenate([rng.uniform(-2, 2, (on_floor.sum(), 2)), np.zeros((on_floor.sum(), 1))], axis=1)
    return points, tints[which] + 0.4 * np.sin(9 * points).sum(axis=1, keepdims=True)
