"""The loss of a photo in few launches, against the operations that it stands for."""

import math

import numpy as np
import pytest
import torch

from sehdr_warp.rasterizer.losses.code_residual import CodeScale, code_residual, code_tensor
from sehdr_warp.rasterizer.losses.photo_loss import ClippedWeights, clipped_light_energy, photo_loss
from sehdr_warp.rasterizer.losses.ssim import image_distance

from ..scenes import relative_error

CLIPPED = ClippedWeights(smoothness=0.7, estimate=0.3)
WHITE, MU, WEIGHTS = 1.3, 300.0, {"distance_weight": 0.8, "dissimilarity_weight": 0.2}


def clipped_photo(dtype, mu):
    """Light [30, 41, 3] around white, codes of which every third is white, and a scale on which white has no end."""
    generator = torch.Generator().manual_seed(3)
    light = WHITE * torch.exp(torch.randn(30, 41, 3, generator=generator, dtype=torch.float64))
    codes = np.random.default_rng(0).integers(0, 256, light.shape).astype(np.uint8)
    codes[::3] = 255
    worth = torch.linspace(0, 1, 256, dtype=torch.float64)
    worth = torch.log1p(mu * worth) / math.log1p(mu) if mu else worth
    table = torch.stack([worth, worth, worth], 1)
    table[-1, 2] = math.inf
    return light.to(dtype), codes, CodeScale(table.to(dtype), mu, WHITE)


def composed(image, codes, scale, index, clipped, estimates):
    loss = image_distance(*code_residual(image, codes, scale, index), **WEIGHTS)
    return loss + clipped_light_energy(image, codes, WHITE, clipped, index, None, estimates) if clipped else loss


@pytest.mark.parametrize("clipped", [ClippedWeights(), CLIPPED], ids=["codes", "and clipped light"])
@pytest.mark.parametrize("mu", [0.0, MU])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_value_and_gradient_are_those_of_the_operations(device, dtype, bound, mu, clipped):
    light, codes, scale = clipped_photo(dtype, mu)
    scale = CodeScale(scale.table.to(device), mu, WHITE)
    stack, index = code_tensor(np.stack([codes[::-1], codes]), device), torch.tensor([1], device=device)
    estimates = torch.rand(7, 9, 6, generator=torch.Generator().manual_seed(1)).half().to(device)
    for targets in ((stack, scale, index), (stack[1], scale, None)):
        ours, theirs = (light.to(device).requires_grad_() for _ in range(2))
        ours_loss = photo_loss(ours, *targets, **WEIGHTS, clipped=clipped, estimates=estimates)
        expected = composed(theirs, *targets, clipped, estimates)
        (3 * ours_loss).backward()
        (3 * expected).backward()
        assert ours_loss.dtype == dtype and ours_loss.shape == ()
        assert relative_error(ours_loss, expected) < bound
        assert relative_error(ours.grad, theirs.grad) < bound


def test_without_a_gradient_the_value_is_the_same(device):
    light, codes, scale = clipped_photo(torch.float32, MU)
    targets = code_tensor(codes, device), CodeScale(scale.table.to(device), MU, WHITE)
    weights = WEIGHTS | {"clipped": CLIPPED}
    image = light.to(device)
    assert torch.equal(photo_loss(image, *targets, **weights), photo_loss(image.requires_grad_(), *targets, **weights))
