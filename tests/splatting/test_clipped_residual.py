"""Comparison with a photo's codes: the kernel against torch's own operations."""

import math

import numpy as np
import pytest
import torch

from sehdr_warp.splatting.clipped_residual import CodeScale, clipped_residual, code_tensor, code_values

from .scenes import relative_error

MU, WHITE, HALF_CODES = 300.0, 1.3, (0.01, 0.03)


def mu_law(exposure):
    return torch.log1p(exposure * MU / WHITE) / math.log1p(MU)


def images(bits):
    """An image [20, 30, 3], a photo's codes [20, 30, 3] with black and white ones, and what each code is worth."""
    generator = torch.Generator().manual_seed(0)
    levels = 2**bits - 1
    light = torch.rand(20, 30, 3, generator=generator, dtype=torch.float64) ** 3 * 2
    photo = (light + 0.1 * torch.randn(light.shape, generator=generator, dtype=torch.float64)).clamp(0, WHITE) / WHITE
    photo[:, :6] = photo[:, :6].round()  # many white and black
    photo[0] = 0.5
    light[0] = 1e-7 * light[0]  # where 1 + x would lose every digit
    light[1] = 0
    codes = (photo * levels).round().numpy().astype(np.uint16 if bits == 16 else np.uint8)
    return light, codes, WHITE * torch.linspace(0, 1, levels + 1, dtype=torch.float64)


def reference(image, codes, worth, half_codes):
    found = torch.from_numpy(codes.astype(np.int64))
    truth = worth[found]
    seen = image
    if half_codes is not None:
        below, above = half_codes
        seen = torch.where(found == len(worth) - 1, truth + (image - truth + below).clamp_max(0), seen)
        seen = torch.where(found == 0, truth + (image - truth - above).clamp_min(0), seen)
    return seen, truth


@pytest.mark.parametrize("half_codes", [HALF_CODES, None])
@pytest.mark.parametrize("mu", [MU, 0.0])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 2e-6), (torch.float64, 1e-13)])
def test_values_and_gradients_are_those_of_torch(device, half_codes, mu, bits, dtype, bound):
    light, codes, worth = images(bits)
    law = mu_law if mu else torch.Tensor.double
    weights = torch.randn(light.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    true_light = light.clone().requires_grad_()
    seen, truth = reference(law(true_light), codes, law(worth), half_codes)
    (seen * weights).sum().backward()
    scale = CodeScale(law(worth).to(device, dtype), mu, WHITE, half_codes)
    ours_light = light.to(device, dtype).requires_grad_()
    ours, told = clipped_residual(ours_light, code_tensor(codes, device), scale)
    (ours * weights.to(device, dtype)).sum().backward()
    assert relative_error(ours, seen) < bound
    assert relative_error(ours[0], seen[0]) < bound
    assert relative_error(told, truth) < bound
    assert relative_error(ours_light.grad, true_light.grad) < bound
    assert not told.requires_grad


@pytest.mark.parametrize("bits", [8, 16])
def test_one_of_a_stack_is_taken_where_it_is(device, bits):
    light, codes, worth = images(bits)
    scale = CodeScale(mu_law(worth).to(device), MU, WHITE, HALF_CODES)
    photo, other = code_tensor(codes, device), code_tensor(codes[::-1].copy(), device)
    stack, index = torch.stack([other, photo, other]), torch.tensor([1], device=device)
    for alone, stacked in zip(
        clipped_residual(light.to(device), photo, scale),
        clipped_residual(light.to(device), stack, scale, index),
        strict=True,
    ):
        assert torch.equal(alone, stacked)


def test_poison_stays_where_it_is(device):
    light = torch.tensor([[[math.nan, math.inf, 1.0]]], device=device)
    codes = torch.full((1, 1, 3), 128, dtype=torch.uint8, device=device)
    scale = CodeScale(torch.linspace(0, 1, 256, device=device), 9.0, 1.0, (0.1, 0.1))
    seen, _ = clipped_residual(light, codes, scale)
    assert seen[0, 0, 0].isnan() and seen[0, 0, 1].isinf()
    assert seen[0, 0, 2].item() == pytest.approx(1.0)


def test_what_does_not_fit_is_refused(device):
    image, scale = torch.zeros(4, 3, 3, device=device), CodeScale(torch.zeros(256, device=device))
    for shape, dtype in (((2, 3, 3), torch.uint8), ((4, 3, 3), torch.int16), ((4, 3, 3), torch.float32)):
        codes = torch.zeros(shape, dtype=dtype)
        with pytest.raises(ValueError, match=r"expected uint8 or int16 \[4, 3, 3\]"):
            clipped_residual(image, codes.to(device), scale)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_codes_come_back_as_values(device, dtype):
    top = np.iinfo(dtype).max
    codes = np.array([0, 1, 100, top // 2 + 1, top], dtype)
    found = code_values(code_tensor(codes, device)).cpu().numpy()
    np.testing.assert_array_equal(found, codes.astype(np.float32) / np.float32(top))
