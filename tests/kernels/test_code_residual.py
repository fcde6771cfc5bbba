"""Comparison with a photo's codes: the kernel against torch's own operations."""

import math

import numpy as np
import pytest
import torch

from sehdr_warp.rasterizer.losses.code_residual import CodeScale, code_residual, code_tensor, code_values

from ..rasterizer.scenes import relative_error

MU, WHITE = 300.0, 1.3


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


def table_of(worth, form):
    """[K, 3]: codes that stand for one value each; for what is between their neighbors, black and white for all that
    is beyond; or these two alone."""
    between = (worth[1:] + worth[:-1]) / 2
    infinity = torch.full((1,), math.inf, dtype=worth.dtype)
    least, most = torch.cat([-infinity, between]), torch.cat([between, infinity])
    inner = slice(1, -1) if form == "ends" else slice(0, None if form == "values" else 0)
    least[inner] = most[inner] = worth[inner]
    return torch.stack([worth, least, most], 1)


def reference(image, codes, table):
    truth, least, most = table[torch.from_numpy(codes.astype(np.int64))].unbind(-1)
    away = (image - most).clamp_min(0) + (image - least).clamp_max(0)
    return torch.where(least < most, truth + away, image), truth


@pytest.mark.parametrize("form", ["between", "ends", "values"])
@pytest.mark.parametrize("mu", [MU, 0.0])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 2e-6), (torch.float64, 1e-13)])
def test_values_and_gradients_are_those_of_torch(device, form, mu, bits, dtype, bound):
    light, codes, worth = images(bits)
    law = mu_law if mu else torch.Tensor.double
    weights = torch.randn(light.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    true_light, table = light.clone().requires_grad_(), table_of(law(worth), form)
    prediction, truth = reference(law(true_light), codes, table)
    (prediction * weights).sum().backward()
    scale = CodeScale(table.to(device, dtype), mu, WHITE)
    ours_light = light.to(device, dtype).requires_grad_()
    ours, target = code_residual(ours_light, code_tensor(codes, device), scale)
    (ours * weights.to(device, dtype)).sum().backward()
    assert relative_error(ours, prediction) < bound
    # Far from what its code stands for, light is that less a difference, with no digits of its own.
    assert form == "between" or relative_error(ours[0], prediction[0]) < bound
    assert relative_error(target, truth) < bound
    assert relative_error(ours_light.grad, true_light.grad) < bound
    assert not target.requires_grad
    unchanged = (ours_light.grad == 0).float().mean()
    assert 0 < unchanged < 1 if form != "values" else unchanged == 0


@pytest.mark.parametrize("bits", [8, 16])
def test_one_of_a_stack_is_taken_where_it_is(device, bits):
    light, codes, worth = images(bits)
    scale = CodeScale(table_of(mu_law(worth), "between").to(device), MU, WHITE)
    photo, other = code_tensor(codes, device), code_tensor(codes[::-1].copy(), device)
    stack, index = torch.stack([other, photo, other]), torch.tensor([1], device=device)
    for alone, stacked in zip(
        code_residual(light.to(device), photo, scale), code_residual(light.to(device), stack, scale, index), strict=True
    ):
        assert torch.equal(alone, stacked)


@pytest.mark.parametrize("form", ["between", "values"])
def test_poison_stays_where_it_is(device, form):
    light = torch.tensor([[[math.nan, math.inf, 1.0]]], device=device)
    codes = torch.full((1, 1, 3), 128, dtype=torch.uint8, device=device)
    scale = CodeScale(table_of(torch.linspace(0, 1, 256), form).to(device), 9.0, 1.0)
    prediction, _ = code_residual(light, codes, scale)
    assert prediction[0, 0, 0].isnan() and prediction[0, 0, 1].isinf()
    assert prediction[0, 0, 2].item() == pytest.approx(1.0, abs=0.003)
    white, target = code_residual(light, codes + 127, scale)
    assert form == "values" or (white[0, 0, 0].isnan() and torch.equal(white[0, 0, 1:], target[0, 0, 1:]))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_codes_come_back_as_values(device, dtype):
    top = np.iinfo(dtype).max
    codes = np.array([0, 1, 100, top // 2 + 1, top], dtype)
    values = code_values(code_tensor(codes, device)).cpu().numpy()
    np.testing.assert_array_equal(values, codes.astype(np.float32) / np.float32(top))
