"""Losses: forms, one-sidedness where the camera saturated, masks, and which side learns."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.renders import PhotoRender
from sehdr_warp.rasterizer.losses.code_residual import code_tensor
from sehdr_warp.rasterizer.losses.ssim import ssim
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import LossConfig
from sehdr_warp.training.losses import MAX_LOG_SIZE, image_loss, ldr_loss, linear_loss, size_loss
from sehdr_warp.training.targets import CODE, Target, code_scale, mu_law, mu_of_knee


def images(seed=0, shape=(12, 14, 3)):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)


def target_of(encoded, response=None, *, truth=None, clipping=True, bits=8):
    """The target of encoded values [H, W, 3]: compared as light where a response is given."""
    white = 2**bits - 1
    codes = (encoded.detach().double() * white).round().numpy().astype(np.uint16 if bits == 16 else np.uint8)
    scale = code_scale(white, response, "cpu", clipping=clipping, dtype=encoded.dtype)
    return Target(code_tensor(codes, "cpu"), scale, exposure_truth=truth)


def row(*values):
    """[1, values, 3] of equal channels."""
    return torch.tensor(values).reshape(1, -1, 1).expand(1, len(values), 3).clone()


@pytest.mark.parametrize("form,weights", [("sum", (1.0, 0.2)), ("blend", (0.8, 0.2))])
def test_forms(form, weights):
    a, b = images()
    expected = weights[0] * (a - b).abs().mean() + weights[1] * (1 - ssim(a, b))
    assert image_loss(a, b, None, form, 0.2).item() == pytest.approx(expected.item(), rel=1e-6)
    assert image_loss(a, b, torch.ones(12, 14, 1), form, 0.2).item() == pytest.approx(expected.item(), rel=1e-6)
    assert image_loss(a, b, None, form, 0.0) == (a - b).abs().mean()


def test_masked_pixels_cost_nothing():
    a, b = images()
    mask = torch.zeros(12, 14, 1)
    mask[:, :7] = 1
    changed = b.clone()
    changed[:, 7:] = 0.123
    assert image_loss(a, b, mask, "sum", 0.2) == image_loss(a, changed, mask, "sum", 0.2)
    expected = (a - b)[:, :7].abs().mean()
    assert image_loss(a, b, mask, "sum", 0.0).item() == pytest.approx(expected.item(), rel=1e-5)


def test_the_psnr_of_a_step_leaves_out_what_the_mask_does():
    image, _ = images()
    target = target_of(image + 0.1 * (0.5 - image).sign())
    mask = torch.ones(12, 14, 1)
    mask[:, :5] = 0
    hidden = torch.where(mask > 0, image, 1 - image)
    assert target.psnr(image) == pytest.approx(20, abs=0.3)
    assert target.psnr(hidden) < 12 and replace(target, mask=mask).psnr(hidden) == pytest.approx(20, abs=0.3)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", [None, "srgb", "hdr-nerf"])
def test_clipped_pixels_push_up_and_black_ones_down_alone(name, bits):
    response = None if name is None else response_by_name(name)
    photo = row(1.0, 1.0, 1.0, 0.5, 0.0, 0.0, 0.0).double()
    # Half a code of 8 bits is nothing below white and above black, whatever bits the photo has.
    encoded = row(1.4, 1 - 0.4 * CODE, 0.8, 0.9, -0.1, 0.4 * CODE, 0.3).double()
    if response is not None:
        clipped = response.decode(encoded.clamp(0, 1))
        encoded = torch.where(encoded > 1, 3 * clipped, torch.where(encoded < 0, 0.0, clipped))
    encoded.requires_grad_()
    target = target_of(photo, response, bits=bits)
    config = LossConfig(ssim_weight=0.0, clipped_smoothness=0.0)
    ldr_loss(PhotoRender(encoded, None, None, None, encoded), target, config).backward()
    assert encoded.grad[0, :, 0].sign().tolist() == [0, 0, -1, 1, 0, 0, 1]


@pytest.mark.parametrize("clipping", [True, False])
def test_clipped_light_evens_out_where_exposures_are_compared(clipping):
    response = response_by_name("srgb")
    light = (response.white * torch.tensor([[1.5, 6.0, 1.5, 1.5]])[..., None].expand(1, 4, 3)).double().requires_grad_()
    config = LossConfig(clipping=clipping, ssim_weight=0.0, clipped_smoothness=1.0)
    target = target_of(torch.ones(1, 4, 3).double(), response, clipping=clipping)
    ldr_loss(PhotoRender(light, light, light, None, light), target, config).backward()
    # Without clipping each is too bright for a photo that shows white.
    assert light.grad[0, :, 0].sign().tolist() == ([-1, 1, -1, -1] if clipping else [1, 1, 1, 1])


def test_clipped_light_is_held_at_its_estimate_as_firmly_as_that_is_sure():
    response = response_by_name("srgb")
    light = (response.white * torch.tensor([[2.0, 8.0, 2.0, 8.0, 8.0]])[..., None].expand(1, 5, 3)).double()
    target = target_of(row(1.0, 1.0, 1.0, 1.0, 0.9).double(), response)
    estimates = torch.zeros(1, 5, 6, dtype=torch.float16)
    estimates[..., :3] = math.log(4)
    estimates[..., 3:] = torch.tensor([1.0, 1.0, 0.1, 0.1, 1.0])[None, :, None]
    config = LossConfig(ssim_weight=0.0, clipped_smoothness=0.0, clipped_estimate=1.0)
    light.requires_grad_()
    ldr_loss(PhotoRender(light, light, light, None, light), replace(target, estimates=estimates), config).backward()
    slopes = (light.grad * light.detach())[0, :, 0]
    assert slopes[0] < 0 < slopes[1]  # A photo's clipped pixels alone: the last is brighter than its photo shows.
    assert (slopes[2:4] / slopes[:2]).tolist() == pytest.approx([0.01, 0.01], rel=1e-2)
    plain = light.detach().requires_grad_()
    ldr_loss(PhotoRender(plain, plain, plain, None, plain), target, config).backward()
    assert plain.grad[0, :4].abs().max() == 0 and plain.grad[0, 4, 0] == light.grad[0, 4, 0]


def test_a_code_is_worth_the_middle_of_what_it_stands_for():
    response = response_by_name("hdr-nerf")
    scale = code_scale(255, response, "cpu", dtype=torch.float64)
    light = response.white * torch.expm1(scale.table[:, 0] * math.log1p(scale.mu)) / scale.mu
    least, most = (float(response.decode((254 + half) / 255)) for half in (-0.5, 0.5))
    # The curve is so flat there that the code stands for one and a half stops.
    assert light[254].item() == pytest.approx(math.sqrt(least * most), rel=1e-3)
    assert light[128].item() == pytest.approx(float(response.decode(128 / 255)), rel=1e-3)


@pytest.mark.parametrize("clipping", [True, False])
def test_light_anywhere_within_what_a_code_stands_for_is_as_good_once_it_is_an_interval(clipping):
    response = response_by_name("hdr-nerf")
    places = torch.linspace(253.6, 254.4, 8, dtype=torch.float64).view(1, -1, 1).expand(1, -1, 3)
    light = response.decode(places / 255).requires_grad_()
    target = target_of(torch.full((1, 8, 3), 254 / 255).double(), response, clipping=clipping)
    for wide in (False, clipping):
        loss = ldr_loss(PhotoRender(light, light, light, None, light), target, LossConfig(clipped_smoothness=0.0))
        (slopes,) = torch.autograd.grad(loss, light)
        assert (loss.item() < 1e-12) == wide and bool((slopes == 0).all()) == wide
        target.scale.use_intervals()


def test_without_clipping_an_overshoot_costs():
    predicted, target = torch.full((2, 2, 3), 1.3), target_of(torch.ones(2, 2, 3), clipping=False)
    loss = ldr_loss(PhotoRender(predicted, None, None, None), target, LossConfig(ssim_weight=0.0))
    assert loss.item() == pytest.approx(0.3, rel=1e-5)


def test_exposures_are_compared_where_the_scale_says_so():
    response = response_by_name("srgb")
    light = images(3)[0].double() * 0.8 + 0.05
    photo = PhotoRender(response.encode_extended(light), light, light, None, light)
    encoded = target_of(images(4)[0].double(), clipping=False)
    plain = image_loss(photo.encoded, encoded.encoded.double(), None, "sum", 0.2).item()
    assert ldr_loss(photo, encoded, LossConfig()).item() == pytest.approx(plain, rel=1e-6)
    assert abs(ldr_loss(photo, target_of(encoded.encoded.double(), response), LossConfig()).item() - plain) > 0.01


@pytest.mark.parametrize("wide", [False, True])
def test_gradients_of_the_photo_loss(wide):
    response = response_by_name("hdr-nerf")
    generator = torch.Generator().manual_seed(4)
    target = target_of(torch.rand(4, 5, 3, generator=generator, dtype=torch.float64), response)
    if wide:
        target.scale.use_intervals()
    light = (torch.rand(4, 5, 3, generator=generator, dtype=torch.float64) + 0.1).requires_grad_()

    def loss(x):
        return ldr_loss(PhotoRender(x, x, x, None, x), target, LossConfig())

    assert torch.autograd.gradcheck(loss, light, eps=1e-7, atol=1e-6)


@pytest.mark.parametrize("bits", [8, 16])
def test_the_mu_law_weighs_shadows_as_the_metric_does(bits):
    response = response_by_name("hdr-nerf")
    codes = row(0.1, 0.6).double()
    target = target_of(codes, response, bits=bits)
    light = response.decode(target.encoded.double())
    loss = ldr_loss(PhotoRender(light, light, light, None, 2 * light), target, LossConfig(ssim_weight=0.0))
    mu = mu_of_knee(response)
    expected = (mu_law(2 * light, response.white, mu) - mu_law(light, response.white, mu)).mean()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-3)


@pytest.mark.parametrize(
    "name, code",
    [("srgb", 8), ("hdr-nerf", 8), ("linear", 8), ("gain-map", 0.5), ("colour:S-Log3", 8 + 255 * 95 / 1023)],
)
def test_the_knee_is_at_its_code_above_black(name, code):
    response = response_by_name(name)
    knee = response.white / mu_of_knee(response)
    assert float(response.encode(knee)) * 255 == pytest.approx(code, rel=1e-3)


def test_truth_supervises_the_base_and_without_it_there_may_be_nothing_to_compare():
    base, truth = images(2)
    photo = PhotoRender(base, torch.zeros_like(base), base, None)
    config = LossConfig(linear_weight=0.5, hdr_truth=True)
    assert linear_loss(photo, target_of(truth, truth=base), config).item() == pytest.approx(0, abs=1e-6)
    assert linear_loss(photo, target_of(truth, truth=truth), config) > 0.1
    assert linear_loss(PhotoRender(base, base, base, None), target_of(base), LossConfig()) is None


@pytest.mark.parametrize("reserved", [0, 5])
def test_the_size_loss_is_the_mean_size_and_its_gradient_is_exact(device, reserved):
    log_scales = torch.randn(40, 3, generator=torch.Generator().manual_seed(1)) - 3
    log_scales[0], log_scales[1] = -math.inf, math.inf
    exact = log_scales.double().clamp_max(MAX_LOG_SIZE).requires_grad_()
    expected = 0.7 * exact.exp().mean()
    expected.backward()
    gaussians = Gaussians.from_points(torch.zeros(40, 3), torch.ones(40, 3), 2).to(device)
    gaussians.log_scales.data.copy_(log_scales)
    optimizer = torch.optim.Adam(gaussians.parameters())
    if reserved:
        gaussians.reserve(40 + reserved, optimizer)
    with gaussians.all_rows(optimizer):
        loss = size_loss(gaussians, 0.7)
        loss.backward()
        gradient = gaussians.log_scales.grad
    assert len(gradient) == 40 + reserved
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
    # The one without bound stays: its size is not that of its parameter.
    torch.testing.assert_close(gradient[2:40].cpu(), exact.grad[2:].float(), rtol=1e-5, atol=0)
    assert gradient.isfinite().all() and not gradient[:2].any() and not gradient[40:].any()
