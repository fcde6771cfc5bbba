"""The catalogue's poison: NaN, infinities, denormal and huge numbers anywhere in the input of the public operations."""

import math

import torch

from ..splatting import rasterize, spherical_harmonics, ssim_map
from .case import Case, count, not_finite
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
    """Harmonics and similarity: NaN stays with its own row or window."""
    generator = torch.Generator().manual_seed(0)
    coefficients = torch.randn(8, 16, 3, generator=generator).to(device)
    means = torch.randn(8, 3, generator=generator).to(device)
    position = torch.zeros(3, device=device)
    rows = pixels = 0
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
    return [
        count("other rows of harmonics not finite", rows),
        count("similarity not finite beyond the window", pixels),
    ]


CASES = (
    Case("poison-gaussians", POISON, "NaN, infinite, huge and denormal numbers in Gaussians", _gaussians),
    Case("poison-camera", POISON, "the same in the camera", _camera),
    Case("poison-others", POISON, "the same in harmonics and similarity", _other_operations),
)
