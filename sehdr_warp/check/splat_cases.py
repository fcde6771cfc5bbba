"""The catalogue's splats: shapes, places, opacities, overlap, radiance."""

import math

import torch

from ..kernels.constants import ALPHA_THRESHOLD, NEAR, TRANSMITTANCE_MIN
from ..splatting import rasterize, spherical_harmonics
from ..splatting.reference import rasterize_reference
from .case import ROUNDINGS, UNIT, Case, Reading, compare, count, not_finite
from .splats import Splats, compare_splat

SPLATS = "splat"


def _scaled(scales) -> callable:
    def measure(device):
        splats = Splats(24)
        splats.log_scales[:] = torch.tensor(scales, dtype=torch.float64).log()
        return compare_splat(splats, device)

    return measure


def _mixed_scales(device):
    """Every size from 1e-7 to 1e4 in one image, the large ones faint."""
    splats = Splats(60)
    splats.log_scales[:] = torch.linspace(math.log(1e-7), math.log(1e4), 60, dtype=torch.float64)[:, None]
    splats.log_scales += torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    splats.opacities[:] = torch.where(splats.log_scales[:, 0] > 0, 0.02, splats.opacities)
    return compare_splat(splats, device)


def _near_plane(device):
    """Depths at, just before and behind the near plane and the camera; what is behind is culled exactly."""
    splats = Splats(16, spread=0.001)
    near = torch.tensor(NEAR, dtype=torch.float32).item()
    # Float32's own roundings of a depth are 1e-9 here: nearer than 1e-6 there is no telling before from behind.
    steps = torch.tensor([-1e3, -1.0, -0.01, -1e-6, 1e-6, 1e-4, 1e-3, 1e-2], dtype=torch.float64)
    splats.means[:8, 2], splats.means[8:, 2] = near + steps, 3.0
    splats.means[:8, :2] = 0.0
    splats.log_scales[:8] = math.log(1e-3)
    readings = compare_splat(splats, device, ties=True)
    splats.means[0, 2] = near
    rendering = rasterize(*splats.float32(device), splats.width, splats.height)
    behind = splats.means[:, 2].float() <= near
    return [*readings, count("drawn behind the near plane", (rendering.visible.cpu() & behind).sum())]


def _border(device):
    """Centres on and just beyond each border and corner of the image."""
    splats = Splats(16, width=33, height=17)
    focal_x, focal_y, cx, cy = splats.intrinsics
    x = torch.tensor([0.0, 33.0, 16.5, 16.5, 0.0, 33.0, 33.0, 0.0, -3.0, 36.0, 16.0, 16.0, -0.01, 33.01, 8.0, 25.0])
    y = torch.tensor([8.5, 8.5, 0.0, 17.0, 0.0, 17.0, 0.0, 17.0, 8.0, 8.0, -3.0, 20.0, 17.01, -0.01, 0.01, 16.99])
    splats.means[:, 0] = (x - cx) / focal_x * splats.means[:, 2]
    splats.means[:, 1] = (y - cy) / focal_y * splats.means[:, 2]
    return compare_splat(splats, device)


def _opacity(device):
    """0, just below, at and just above the threshold, the limit of 0.999, and 1."""
    splats = Splats(12)
    step = ALPHA_THRESHOLD
    given = [0.0, 0.5 * step, step * (1 - 1e-6), step, step * (1 + 1e-3), 0.5, 0.998, 0.999, 0.9995, 1.0, 1.0, 0.1]
    splats.opacities[:] = torch.tensor(given, dtype=torch.float64)
    return compare_splat(splats, device)


def _overlap(number: int, opacity: float, threshold: float) -> callable:
    def measure(device):
        splats = Splats(number, width=4, height=4, spread=0.2)
        splats.log_scales[:] = torch.tensor([0.3, 0.5, 0.7], dtype=torch.float64).log()
        splats.opacities[:] = opacity
        splats.means[:, 2] = torch.linspace(2.0, 6.0, number, dtype=torch.float64)
        splats.options = {"alpha_threshold": threshold}
        # Every Gaussian rounds the pixel's transmittance once: a random walk of as many steps as are counted.
        steps = min(number, math.log(1 / TRANSMITTANCE_MIN) / opacity)
        return compare_splat(splats, device, ties=True, extra=ROUNDINGS * UNIT * math.sqrt(steps))

    return measure


def _equal_depths(device):
    """All at one depth: their order is that of their indices, on every device and in every run."""
    splats = Splats(60)
    splats.means[:, 2] = 3.0
    readings = compare_splat(splats, device, ties=True)
    runs = [rasterize(*splats.float32(device), splats.width, splats.height).image for _ in range(2)]
    return [*readings, count("numbers that differ between two runs", (runs[0] != runs[1]).sum())]


def _radiance(low: float, high: float) -> callable:
    def measure(device):
        splats = Splats(50)
        exponents = torch.linspace(math.log10(low), math.log10(high), 50, dtype=torch.float64)
        order = torch.randperm(50, generator=torch.Generator().manual_seed(1))
        splats.features[:] = 10.0 ** exponents[order][:, None]
        return compare_splat(splats, device)

    return measure


def _dim_before_bright(device):
    """Sixteen decades within a pixel: the dim Gaussians' own gradients, with a light 1e16 times brighter behind."""
    splats = Splats(30, spread=0.8)
    splats.opacities *= 0.4
    splats.features[:] = 1e-8
    splats.features[splats.means[:, 2].argmax()] = 1e8
    readings = compare_splat(splats, device)
    # Without the light: the dim ones alone carry the image.
    splats.features[splats.means[:, 2].argmax()] = 1e-8
    return readings + [Reading(f"{r.quantity}, dim alone", r.error, r.bound) for r in compare_splat(splats, device)]


def _sizes(device):
    """1 x 1, odd sizes, one pixel beyond a tile, and a line of pixels."""
    readings = []
    for width, height in ((1, 1), (17, 33), (15, 1), (1, 50)):
        splats = Splats(30, width, height)
        readings += [
            Reading(f"{r.quantity} {width} x {height}", r.error, r.bound) for r in compare_splat(splats, device)
        ]
    return readings


def _quaternions(device):
    """Lengths from 1e-12 to 1e15 turn as unit ones do; the gradient scales with 1 / length."""
    readings = []
    for length in (1e-12, 1e-6, 1e6, 1e15):
        splats = Splats(20)
        splats.quaternions *= length / splats.quaternions.norm(dim=1, keepdim=True)
        readings += [Reading(f"{r.quantity} at {length:g}", r.error, r.bound) for r in compare_splat(splats, device)]
    splats = Splats(20)
    splats.quaternions[:] = 0.0
    zero = rasterize(*splats.float32(device), splats.width, splats.height).image
    splats.quaternions[:, 0] = 1.0
    one = rasterize(*splats.float32(device), splats.width, splats.height).image
    return [*readings, count("numbers in which zero differs from the identity", (zero != one).sum())]


def _far(distance: float) -> callable:
    """Places in the image, in pixels, of a scene far from the origin before a camera that is turned."""

    def measure(device):
        splats = Splats(30)
        turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64))[0]
        turn = turn * torch.linalg.det(turn)
        offset = torch.tensor([distance, -0.7 * distance, 0.4 * distance], dtype=torch.float64)
        splats.means = ((splats.means + offset) @ turn).float().double()
        splats.world_to_camera[:3, :3], splats.world_to_camera[:3, 3] = turn.float().double(), -offset.float().double()
        tensors = splats.float32(device)
        rendering = rasterize(*tensors, splats.width, splats.height)
        exact = [tensor.double().cpu() for tensor in tensors]
        truth = rasterize_reference(*exact, splats.width, splats.height)
        both = rendering.visible.cpu() & truth.visible
        error = (rendering.means2d.cpu().double() - truth.means2d)[both].norm(dim=1).max()
        nearest, focal = float(truth.depths[both].min()), float(splats.intrinsics[0])
        # Each coordinate before the camera is a sum of four numbers as large as the distance.
        bound = 4 * math.sqrt(3) * UNIT * 1.3 * distance * focal / nearest
        return [Reading("centres, pixels", float(error), bound), count("not finite", not_finite(rendering.image))]

    return measure


def _far_tiny(device):
    """Far before the camera rather than far from the origin: 1e6 units away and as large."""
    splats = Splats(30)
    splats.means *= 1e6
    splats.log_scales += math.log(1e6)
    return compare_splat(splats, device)


def _harmonics(device):
    """Degree 3 from all around, from 1e-6 to 1e6 units away; and at the very place of the camera, which is finite."""
    generator = torch.Generator().manual_seed(3)
    offsets = torch.randn(60, 3, generator=generator, dtype=torch.float64)
    offsets *= torch.logspace(-6, 6, 60, dtype=torch.float64)[:, None]
    coefficients = torch.randn(60, 16, 3, generator=generator, dtype=torch.float64)
    position = torch.zeros(3, dtype=torch.float64)
    tensors = {"coefficients": coefficients, "means": offsets, "camera_position": position}

    def evaluate(coefficients, means, position):
        return {"values": spherical_harmonics(3, coefficients, means, position)}

    readings = compare(evaluate, lambda disturb, *t: evaluate(*t), tensors, device, gradients=("coefficients", "means"))
    at_camera = [t.to(device, torch.float32).requires_grad_() for t in (coefficients[:1], torch.zeros(1, 3), position)]
    value = spherical_harmonics(3, *at_camera)
    value.sum().backward()
    return [*readings, count("not finite at the camera", not_finite(value, *(t.grad for t in at_camera)))]


CASES = (
    Case("scale-tiny", SPLATS, "standard deviations from 1e-7", _scaled([1e-7, 2e-7, 5e-7])),
    Case(
        "scale-huge",
        SPLATS,
        "standard deviations from 1e4: each covers the image",
        _scaled([1e4, 2e4, 5e4]),
        note="a Gaussian wider than about 4e9 pixels overflows the determinant and is culled",
    ),
    Case("scale-mixed", SPLATS, "standard deviations from 1e-7 to 1e4 in one image", _mixed_scales),
    Case(
        "needle",
        SPLATS,
        "needles, 1e6 times longer than thick",
        _scaled([1e1, 1e-5, 1e-5]),
        note="the conic's three terms cancel along a needle: error grows with the square of the distance in pixels",
    ),
    Case("disc", SPLATS, "discs, 1e6 times wider than thick", _scaled([1e1, 1e1, 1e-5])),
    Case("near-plane", SPLATS, "at, before and behind the near plane", _near_plane),
    Case("border", SPLATS, "centres on and beyond the image's borders", _border),
    Case("subpixel", SPLATS, "a thousandth of a pixel wide", _scaled([1e-4, 2e-5, 5e-5])),
    Case("opacity", SPLATS, "opacity 0, 1/255, 0.999, 1 and next to them", _opacity),
    Case("overlap-100k", SPLATS, "10^5 Gaussians in one tile, all counted", _overlap(100_000, 5e-5, 1e-6), quick=False),
    Case(
        "overlap-opaque", SPLATS, "10^4 Gaussians in one tile, finished early", _overlap(10_000, 0.02, ALPHA_THRESHOLD)
    ),
    Case("equal-depths", SPLATS, "60 Gaussians at one depth", _equal_depths),
    Case("radiance-dark", SPLATS, "radiance from 1e-12 to 1e-8", _radiance(1e-12, 1e-8)),
    Case("radiance-bright", SPLATS, "radiance from 1e5 to 1e9", _radiance(1e5, 1e9)),
    Case("radiance-range", SPLATS, "radiance from 1e-12 to 1e9 in one image", _radiance(1e-12, 1e9)),
    Case("decades", SPLATS, "16 decades of radiance within a pixel", _dim_before_bright),
    Case("image-sizes", SPLATS, "images of 1 x 1 and of odd size", _sizes),
    Case("quaternions", SPLATS, "unnormalised, zero and huge quaternions", _quaternions),
    Case("far-1e3", SPLATS, "scene and camera 1e3 units from the origin", _far(1e3)),
    Case(
        "far-1e6",
        SPLATS,
        "scene and camera 1e6 units from the origin",
        _far(1e6),
        note="float32 places are 0.06 units apart there: move the scene to the origin before training",
    ),
    Case("far-away", SPLATS, "1e6 units before the camera, and as large", _far_tiny),
    Case("harmonics", SPLATS, "spherical harmonics from 1e-6 to 1e6 units, and at the camera", _harmonics),
)
