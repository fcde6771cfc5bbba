"""Splats: shapes, opacities, overlap, radiance, harmonics, and poison in their arguments."""

import math
from collections.abc import Callable, Iterable, Iterator
from itertools import product
from typing import Any

import torch
from torch import Tensor

from ..kernels.constants import ALPHA_THRESHOLD, EPS2D, NEAR_PLANE, TRANSMITTANCE_MIN
from ..rasterizer import rasterize, spherical_harmonics
from ..rasterizer.reference import blend_reference, project_reference
from .case import ROUNDINGS, UNIT, Case, Reading, as_float32, compare, count, not_finite

NAMES = ("means", "log_scales", "quaternions", "opacities", "features", "world_to_camera", "intrinsics")
SIZES = ((1, 1), (17, 33), (15, 1), (1, 50))
POISON = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-40)


class Splats:
    """Arguments of rasterize() in float64, which a case may change.

    Attributes:
        ties: depths are equal and ordered by index, so they are not disturbed.
        extra: as of compare().
        label: as of compare().
        options: further arguments of the rasterizer.
    """

    ties, extra = False, 0.0

    def __init__(self, count=40, width=40, height=30, *, spread=2.0, scales=None, radiance=None, label="{}"):
        """Place random Gaussians before a camera.

        Args:
            count: number of Gaussians.
            width: of the image, pixels.
            height: of the image, pixels.
            spread: extent of the means in x and y.
            scales: standard deviations of every Gaussian, instead of random ones.
            radiance: low and high; radiance from 10^low to 10^high in a random order.
            label: as of compare().
        """
        random: dict[str, Any] = {"generator": torch.Generator().manual_seed(0), "dtype": torch.float64}
        self.width, self.height, self.label = width, height, label
        self.means = (torch.rand(count, 3, **random) - 0.5) * torch.tensor([spread, spread, 2.0])
        self.means[:, 2] += 3
        self.log_scales = torch.log(0.05 + 0.25 * torch.rand(count, 3, **random))
        self.quaternions = torch.randn(count, 4, **random)
        self.opacities = 0.05 + 0.9 * torch.rand(count, **random)
        self.features = torch.exp(torch.randn(count, 3, **random))
        self.world_to_camera = torch.eye(4, dtype=torch.float64)
        focal = 0.9 * max(width, height)
        self.intrinsics = torch.tensor([focal, focal, width / 2 + 0.3, height / 2 - 0.2], dtype=torch.float64)
        self.options = {
            "near_plane": NEAR_PLANE,
            "eps2d": EPS2D,
            "alpha_threshold": ALPHA_THRESHOLD,
            "antialiased": False,
        }
        if scales is not None:
            self.log_scales[:] = torch.tensor(scales, dtype=torch.float64).log()
        if radiance is not None:
            low, high = radiance
            order = torch.randperm(count, generator=torch.Generator().manual_seed(1))
            self.features[:] = 10.0 ** torch.linspace(low, high, count, dtype=torch.float64)[order][:, None]

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Return the tensor arguments by name."""
        return {name: getattr(self, name) for name in NAMES}

    def float32(self, device) -> list[Tensor]:
        """Return the tensor arguments in float32 on a device."""
        return [tensor.to(device, torch.float32) for tensor in self.tensors.values()]

    def render(self, *tensors: Tensor):
        """Rasterize tensor arguments at the size of the image."""
        return rasterize(*tensors, width=self.width, height=self.height)


def compare_splats(splats: Splats, device: torch.device) -> list[Reading]:
    """Compare image, alpha and gradients of rasterize() with the float64 reference."""
    render_options = {"width": splats.width, "height": splats.height} | splats.options

    def ours(*tensors):
        rendering = rasterize(*tensors, **render_options)
        return {"image": rendering.image, "alpha": rendering.alpha}

    def project(means, log_scales, quaternions, opacities, features, pose, intrinsics):
        return project_reference(means, log_scales, quaternions, opacities, pose, intrinsics, **render_options)

    exact_depths = project(*as_float32(splats.tensors.values()))[2]

    def truth(disturb, *tensors):
        means2d, conics, depths, opacities2d, extents = project(*tensors)
        depths = exact_depths if splats.ties else disturb(depths.detach())
        crossing = disturb(means2d), disturb(conics), disturb(opacities2d), tensors[4], depths, extents
        image, transmittance = blend_reference(
            *crossing, width=splats.width, height=splats.height, alpha_threshold=splats.options["alpha_threshold"]
        )
        return {"image": image, "alpha": 1.0 - transmittance}

    return compare(
        ours, splats.tensors, device, truth=truth, gradients=NAMES[:5], label=splats.label, extra=splats.extra
    )


def measure_of(make: Callable[[], Splats | Iterable[Splats]]) -> Callable[[torch.device], Iterator[Reading]]:
    """Return a measure that compares the splats, one or several, that a function makes."""

    def measure(device):
        group = make()
        for splats in (group,) if isinstance(group, Splats) else group:
            yield from compare_splats(splats, device)

    return measure


def overlap(number: int, opacity: float, threshold: float) -> Splats:
    """Place Gaussians one behind the other in one tile."""
    splats = Splats(number, width=4, height=4, spread=0.2, scales=(0.3, 0.5, 0.7))
    splats.opacities[:] = opacity
    splats.means[:, 2] = torch.linspace(2.0, 6.0, number, dtype=torch.float64)
    splats.options["alpha_threshold"] = threshold
    # Each counted Gaussian rounds the pixel's transmittance once: a random walk.
    steps = min(number, math.log(1 / TRANSMITTANCE_MIN) / opacity)
    splats.ties, splats.extra = True, ROUNDINGS * UNIT * math.sqrt(steps)
    return splats


def _mixed_scales() -> Splats:
    splats = Splats(60)
    splats.log_scales[:] = torch.linspace(math.log(1e-7), math.log(1e4), 60, dtype=torch.float64)[:, None]
    splats.log_scales += torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    splats.opacities[splats.log_scales[:, 0] > 0] = 0.02  # the large ones are faint
    return splats


def _near_threshold() -> Splats:
    splats, step = Splats(12), ALPHA_THRESHOLD
    opacities = [0.0, 0.5 * step, step * (1 - 1e-6), step, step * (1 + 1e-3), 0.5, 0.998, 0.999, 0.9995, 1.0, 1.0, 0.1]
    splats.opacities[:] = torch.tensor(opacities, dtype=torch.float64)
    return splats


def _equal_depths(device):
    """Compare Gaussians at one depth, which are ordered by index on every device and in every run."""
    splats = Splats(60)
    splats.means[:, 2] = 3.0
    splats.ties = True
    yield from compare_splats(splats, device)
    first, again = (splats.render(*splats.float32(device)).image for _ in range(2))
    yield count("numbers that differ between two runs", (first != again).sum())


def _harmonics(device):
    """Compare degree 3 from all directions, and count numbers that are not finite at the camera's own position."""
    random: dict[str, Any] = {"generator": torch.Generator().manual_seed(3), "dtype": torch.float64}
    offsets = torch.randn(60, 3, **random) * torch.logspace(-6, 6, 60, dtype=torch.float64)[:, None]
    coefficients, position = torch.randn(60, 16, 3, **random), torch.zeros(3, dtype=torch.float64)
    tensors = {"coefficients": coefficients, "means": offsets, "camera_position": position}
    yield from compare(
        lambda *t: {"values": spherical_harmonics(3, *t)}, tensors, device, gradients=("coefficients", "means")
    )
    at_camera = [t.to(device, torch.float32).requires_grad_() for t in (coefficients[:1], torch.zeros(1, 3), position)]
    value = spherical_harmonics(3, *at_camera)
    value.sum().backward()
    yield count("not finite at the camera", not_finite(value, *(t.grad for t in at_camera)))


def _poisoned_gaussians(device):
    """Poison one number of one Gaussian at a time, and count effects on the others."""
    leaked = gradients = changed = 0
    others = torch.arange(12, device=device) != 5
    for (which, name), value in product(enumerate(NAMES[:5]), POISON):
        if name == "opacities" and math.isfinite(value) and abs(value) > 1:
            continue  # refused by an error
        splats = Splats(12, 20, 18)
        tensors = splats.float32(device)
        tensors[which].view(12, -1)[5, 0] = value
        leaves = [tensor.clone().requires_grad_() for tensor in tensors]
        rendering = splats.render(*leaves)
        slopes = torch.autograd.grad(rendering.image.sum() + rendering.alpha.sum(), leaves[:5])
        # A feature near float32's limit may overflow in the pixels that show it; nothing else may.
        if not (name == "features" and math.isfinite(value)):
            leaked += not_finite(rendering.image, rendering.alpha)
            gradients += not_finite(*(slope[others] for slope in slopes))
        if not bool(rendering.visible[5]):
            remaining = [*(tensor[others] for tensor in tensors[:5]), *tensors[5:]]
            without = splats.render(*remaining)
            changed += int((without.image != rendering.image).sum())
    yield count("pixels not finite", leaked)
    yield count("gradients of others not finite", gradients)
    yield count("pixels changed by a culled Gaussian", changed)


CASES = (
    Case("scale-mixed", "standard deviations from 1e-7 to 1e4 in one image", measure_of(_mixed_scales)),
    Case("needle", "needles, 1e6 times longer than thick", measure_of(lambda: Splats(24, scales=(1e1, 1e-5, 1e-5))),
         note="the conic's three terms cancel along a needle: error grows with the square of the distance in pixels"),
    Case("opacity", "opacity 0, 1/255, 0.999, 1 and next to them", measure_of(_near_threshold)),
    Case("overlap-opaque", "10^4 Gaussians in one tile, finished early",
         measure_of(lambda: overlap(10_000, 0.02, ALPHA_THRESHOLD))),
    Case("equal-depths", "60 Gaussians at one depth", _equal_depths),
    Case("radiance-range", "radiance from 1e-12 to 1e9 at once", measure_of(lambda: Splats(50, radiance=(-12, 9)))),
    Case("image-sizes", "images of 1 x 1 and of odd size",
         measure_of(lambda: (Splats(30, *size, label="{{}} {} x {}".format(*size)) for size in SIZES))),
    Case("harmonics", "spherical harmonics from 1e-6 to 1e6 units, and at the camera", _harmonics),
    Case("poison-gaussians", "NaN, infinite, huge and denormal numbers in Gaussians", _poisoned_gaussians, "poison"),
)  # fmt: skip
