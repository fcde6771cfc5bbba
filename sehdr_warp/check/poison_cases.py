"""The catalogue's poison: NaN, infinities, denormal and huge numbers anywhere in the input of the public operations."""

import math

import torch

from ..errors import SehdrError
from ..splatting import nearest_neighbour_distances, rasterize, spherical_harmonics, ssim_map
from .case import Case, Reading, count, not_finite
from .splats import NAMES, Splats

POISON = "poison"
VALUES = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-40)


def _backward(rendering) -> None:
    (rendering.image.sum() + rendering.alpha.sum()).backward()


def _gaussians(device):
    """One poisoned number of one Gaussian at a time: it is drawn rightly or culled, and the others do not notice."""
    leaked = gradients = changed = 0
    for which, name in enumerate(NAMES[:5]):
        for value in VALUES:
            splats = Splats(12, 20, 18)
            tensors = splats.float32(device)
            tensors[which][5, ...] = torch.where(
                torch.arange(tensors[which][5].numel(), device=device) == 0, value, tensors[which][5].reshape(-1)
            ).reshape(tensors[which][5].shape)
            leaves = [tensor.clone().requires_grad_() for tensor in tensors]
            rendering = rasterize(*leaves, splats.width, splats.height)
            _backward(rendering)
            others = torch.arange(12, device=device) != 5
            # A feature near float32's limit may overflow in the pixels that show it; nothing else may.
            shown = name == "features" and math.isfinite(value)
            leaked += 0 if shown else not_finite(rendering.image, rendering.alpha)
            gradients += 0 if shown else sum(not_finite(leaf.grad[others]) for leaf in leaves[:5])
            if not bool(rendering.visible[5]):
                kept = [tensor[others] for tensor in tensors[:5]]
                without = rasterize(*kept, *tensors[5:], splats.width, splats.height)
                changed += int((without.image != rendering.image).sum())
    return [
        count("pixels not finite", leaked),
        count("gradients of others not finite", gradients),
        count("pixels changed by a culled Gaussian", changed),
    ]


def _camera(device):
    """A camera that is not finite shows nothing; a huge one shows nothing that is not finite."""
    wrong = 0
    for which in (5, 6):
        for value in VALUES:
            for at in range(4):
                splats = Splats(12, 20, 18)
                tensors = splats.float32(device)
                tensors[which].view(-1)[at] = value
                rendering = rasterize(*tensors, splats.width, splats.height)
                wrong += not_finite(rendering.image, rendering.alpha)
                if not math.isfinite(value):
                    wrong += int(rendering.image.count_nonzero())
    return [count("pixels shown or not finite", wrong)]


def _other_operations(device):
    """Harmonics, similarity and neighbours: NaN stays with its own row or window, or is refused by name."""
    generator = torch.Generator().manual_seed(0)
    coefficients = torch.randn(8, 16, 3, generator=generator).to(device)
    means = torch.randn(8, 3, generator=generator).to(device)
    position = torch.zeros(3, device=device)
    rows = pixels = accepted = 0
    for value in VALUES:
        for poisoned in (0, 1):
            given = [coefficients.clone(), means.clone()]
            given[poisoned][3].view(-1)[0] = value
            result = spherical_harmonics(3, *given, position)
            rows += not_finite(torch.cat([result[:3], result[4:]]))
        image = torch.rand(30, 30, 3, generator=generator).to(device)
        spoiled = image.clone()
        spoiled[4, 4, 0] = value
        similarity = ssim_map(spoiled, image)
        # The window reaches five pixels.
        pixels += not_finite(similarity[10:], similarity[:, 10:], similarity[..., 1:])
        if not math.isfinite(value):
            points = means.clone()
            points[2, 1] = value
            try:
                nearest_neighbour_distances(points)
                accepted += 1
            except SehdrError:
                pass
    return [
        count("other rows of harmonics not finite", rows),
        count("similarity not finite beyond the window", pixels),
        count("points accepted that are not finite", accepted),
    ]


def _neighbours(device):
    """Distances within and between clusters 1e-30 and 1e30 apart, and of points that coincide."""
    base = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 0]], dtype=torch.float64)
    readings = []
    for scale in (1e-30, 1.0, 1e30):
        points = (base * scale).to(device, torch.float32)
        found = nearest_neighbour_distances(points, 3).double().cpu()
        exact = torch.cdist(points.double().cpu() / scale, points.double().cpu() / scale)
        exact = (exact + torch.diag(torch.full((4,), math.inf, dtype=torch.float64))).sort(1).values[:, :3] * scale
        error = float(((found - exact).abs() / exact.clamp_min(1e-300)).max())
        readings.append(Reading(f"distances at {scale:g}", error, 4 * 2.0**-24))
    return readings


CASES = (
    Case("poison-gaussians", POISON, "NaN, infinite, huge and denormal numbers in Gaussians", _gaussians),
    Case("poison-camera", POISON, "the same in the camera", _camera),
    Case("poison-others", POISON, "the same in harmonics, similarity and neighbours", _other_operations),
    Case("neighbours", POISON, "neighbours 1e-30 and 1e30 apart", _neighbours),
)
