"""Splats: shapes, places, opacities, overlap, radiance, and poison in their arguments."""

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor

from ..kernels.constants import ALPHA_THRESHOLD, EPS2D, NEAR_PLANE, TRANSMITTANCE_MIN
from ..rasterizer import rasterize, spherical_harmonics, ssim_map
from ..rasterizer.reference import blend_reference, project_reference, rasterize_reference
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


def _far_away() -> Splats:
    splats = Splats(30)
    splats.means *= 1e6
    splats.log_scales += math.log(1e6)
    return splats


def _light_behind() -> Iterator[Splats]:
    """Place dim Gaussians, whose gradients must survive, before a bright one, and before a dim one."""
    for radiance, label in ((1e8, "{}"), (1e-8, "{}, dim alone")):
        splats = Splats(30, spread=0.8, label=label)
        splats.opacities *= 0.4
        splats.features[:] = 1e-8
        splats.features[splats.means[:, 2].argmax()] = radiance
        yield splats


def _on_borders() -> Splats:
    splats = Splats(16, width=33, height=17)
    focal_x, focal_y, cx, cy = splats.intrinsics
    x = torch.tensor([0.0, 33.0, 16.5, 16.5, 0.0, 33.0, 33.0, 0.0, -3.0, 36.0, 16.0, 16.0, -0.01, 33.01, 8.0, 25.0])
    y = torch.tensor([8.5, 8.5, 0.0, 17.0, 0.0, 17.0, 0.0, 17.0, 8.0, 8.0, -3.0, 20.0, 17.01, -0.01, 0.01, 16.99])
    splats.means[:, 0] = (x - cx) / focal_x * splats.means[:, 2]
    splats.means[:, 1] = (y - cy) / focal_y * splats.means[:, 2]
    return splats


def _near_plane(device):
    """Compare Gaussians around the near plane, and count those behind it that are drawn."""
    splats = Splats(16, spread=0.001)
    near = torch.tensor(NEAR_PLANE, dtype=torch.float32).item()
    # Float32's own roundings of a depth are 1e-9 here: nearer than 1e-6 there is no telling before from behind.
    steps = torch.tensor([-1e3, -1.0, -0.01, -1e-6, 1e-6, 1e-4, 1e-3, 1e-2], dtype=torch.float64)
    splats.means[:8, 2], splats.means[8:, 2] = near + steps, 3.0
    splats.means[:8, :2] = 0.0
    splats.log_scales[:8] = math.log(1e-3)
    splats.ties = True
    yield from compare_splats(splats, device)
    splats.means[0, 2] = near
    behind = splats.means[:, 2].float() <= near
    yield count("drawn behind the near plane", (splats.render(*splats.float32(device)).visible.cpu() & behind).sum())


def _equal_depths(device):
    """Compare Gaussians at one depth, which are ordered by index on every device and in every run."""
    splats = Splats(60)
    splats.means[:, 2] = 3.0
    splats.ties = True
    yield from compare_splats(splats, device)
    first, again = (splats.render(*splats.float32(device)).image for _ in range(2))
    yield count("numbers that differ between two runs", (first != again).sum())


def _quaternions(device):
    """Compare quaternions with lengths from 1e-12 to 1e15, and zero with the identity."""
    splats = Splats(20)
    for length in (1e-12, 1e-6, 1e6, 1e15):
        splats.quaternions *= length / splats.quaternions.norm(dim=1, keepdim=True)
        splats.label = f"{{}} at {length:g}"
        yield from compare_splats(splats, device)
    splats.quaternions[:] = 0.0
    zero = splats.render(*splats.float32(device)).image
    splats.quaternions[:, 0] = 1.0
    wrong = (zero != splats.render(*splats.float32(device)).image).sum()
    yield count("numbers in which zero differs from the identity", wrong)


def _far(distance: float, device):
    """Compare centers, in pixels, of a scene far from the origin before a rotated camera."""
    splats = Splats(30)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)
    offset = torch.tensor([distance, -0.7 * distance, 0.4 * distance], dtype=torch.float64)
    splats.means = ((splats.means + offset) @ turn).float().double()
    splats.world_to_camera[:3, :3], splats.world_to_camera[:3, 3] = turn.float().double(), -offset.float().double()
    rendering = splats.render(*splats.float32(device))
    exact = as_float32(splats.tensors.values())
    truth = rasterize_reference(*exact, width=splats.width, height=splats.height)
    both = rendering.visible.cpu() & truth.visible
    error = (rendering.means2d.cpu().double() - truth.means2d)[both].norm(dim=1).max()
    nearest, focal = float(truth.depths[both].min()), float(splats.intrinsics[0])
    # Each coordinate before the camera is a sum of four numbers as large as the distance.
    bound = 4 * math.sqrt(3) * UNIT * 1.3 * distance * focal / nearest
    yield Reading("centers, pixels", float(error), bound)
    yield count("not finite", not_finite(rendering.image))


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


def _poisoned_camera(device):
    """Poison one number of the camera at a time: it is refused, or nothing is shown if it is not finite."""
    wrong = 0
    for which, value, place in product((5, 6), POISON, range(4)):
        splats = Splats(12, 20, 18)
        tensors = splats.float32(device)
        tensors[which].view(-1)[place] = value
        try:
            rendering = splats.render(*tensors)
        except ValueError:  # Refused on the CPU, which can look at the camera without waiting for a GPU.
            continue
        wrong += not_finite(rendering.image, rendering.alpha)
        wrong += 0 if math.isfinite(value) else int(rendering.image.count_nonzero())
    yield count("pixels shown or not finite", wrong)


def _poisoned_others(device):
    """Poison one number of harmonics or images, and count effects outside of its row or window."""
    generator = torch.Generator().manual_seed(0)
    coefficients = torch.randn(8, 16, 3, generator=generator).to(device)
    means = torch.randn(8, 3, generator=generator).to(device)
    rows = pixels = 0
    for value in POISON:
        for poisoned in (0, 1):
            arguments = [coefficients.clone(), means.clone()]
            arguments[poisoned][3].view(-1)[0] = value
            result = spherical_harmonics(3, *arguments, camera_position=torch.zeros(3, device=device))
            rows += not_finite(torch.cat([result[:3], result[4:]]))
        image = torch.rand(30, 30, 3, generator=generator).to(device)
        spoiled = image.clone()
        spoiled[4, 4, 0] = value
        similarity = ssim_map(spoiled, image)
        pixels += not_finite(similarity[10:], similarity[:, 10:], similarity[..., 1:])  # the window reaches five pixels
    yield count("other rows of harmonics not finite", rows)
    yield count("similarity not finite beyond the window", pixels)


SPLAT_CASES = (
    Case("scale-tiny", "standard deviations from 1e-7", measure_of(lambda: Splats(24, scales=(1e-7, 2e-7, 5e-7)))),
    Case("scale-huge", "standard deviations from 1e4: each covers the image",
         measure_of(lambda: Splats(24, scales=(1e4, 2e4, 5e4))),
         note="a Gaussian wider than about 4e9 pixels overflows the determinant and is culled"),
    Case("scale-mixed", "standard deviations from 1e-7 to 1e4 in one image", measure_of(_mixed_scales)),
    Case("needle", "needles, 1e6 times longer than thick", measure_of(lambda: Splats(24, scales=(1e1, 1e-5, 1e-5))),
         note="the conic's three terms cancel along a needle: error grows with the square of the distance in pixels"),
    Case("disc", "discs, 1e6 times wider than thick", measure_of(lambda: Splats(24, scales=(1e1, 1e1, 1e-5)))),
    Case("near-plane", "at, before and behind the near plane", _near_plane),
    Case("border", "centers on and beyond the image's borders", measure_of(_on_borders)),
    Case("subpixel", "a thousandth of a pixel wide", measure_of(lambda: Splats(24, scales=(1e-4, 2e-5, 5e-5)))),
    Case("opacity", "opacity 0, 1/255, 0.999, 1 and next to them", measure_of(_near_threshold)),
    Case("overlap-100k", "10^5 Gaussians in one tile, all counted",
         measure_of(lambda: overlap(100_000, 5e-5, 1e-6)), quick=False),
    Case("overlap-opaque", "10^4 Gaussians in one tile, finished early",
         measure_of(lambda: overlap(10_000, 0.02, ALPHA_THRESHOLD))),
    Case("equal-depths", "60 Gaussians at one depth", _equal_depths),
    Case("radiance-dark", "radiance from 1e-12 to 1e-8", measure_of(lambda: Splats(50, radiance=(-12, -8)))),
    Case("radiance-bright", "radiance from 1e5 to 1e9", measure_of(lambda: Splats(50, radiance=(5, 9)))),
    Case("radiance-range", "radiance from 1e-12 to 1e9 at once", measure_of(lambda: Splats(50, radiance=(-12, 9)))),
    Case("decades", "16 decades of radiance within a pixel", measure_of(_light_behind)),
    Case("image-sizes", "images of 1 x 1 and of odd size",
         measure_of(lambda: (Splats(30, *size, label="{{}} {} x {}".format(*size)) for size in SIZES))),
    Case("quaternions", "unnormalized, zero and huge quaternions", _quaternions),
    Case("far-1e3", "scene and camera 1e3 units from the origin", partial(_far, 1e3)),
    Case("far-1e6", "scene and camera 1e6 units from the origin", partial(_far, 1e6),
         note="float32 places are 0.06 units apart there: move the scene to the origin before training"),
    Case("far-away", "1e6 units before the camera, and as large", measure_of(_far_away)),
    Case("harmonics", "spherical harmonics from 1e-6 to 1e6 units, and at the camera", _harmonics),
)  # fmt: skip
POISON_CASES = (
    Case("poison-gaussians", "NaN, infinite, huge and denormal numbers in Gaussians", _poisoned_gaussians, "poison"),
    Case("poison-camera", "the same in the camera", _poisoned_camera, "poison"),
    Case("poison-others", "the same in harmonics and similarity", _poisoned_others, "poison"),
)
