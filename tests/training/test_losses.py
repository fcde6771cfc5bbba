"""Losses: forms, one-sidedness where the camera saturated, masks, and which side learns."""

import dataclasses
import math
from dataclasses import replace

import pytest
import torch

from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.renders import PhotoRender
from sehdr_warp.rasterizer import Rendering
from sehdr_warp.rasterizer.losses.ssim import ssim
from sehdr_warp.response import ToneMapper, response_by_name
from sehdr_warp.runs.config import LossConfig
from sehdr_warp.training.losses import (
    MAX_LOG_SIZE,
    anchor_loss,
    data_loss,
    hdr_loss,
    image_loss,
    ldr_loss,
    linear_loss,
    size_loss,
    transmittance_loss,
)
from sehdr_warp.training.targets import CODE, mu_law, mu_of_knee

from .test_targets import images, row, target_of
from .toy import make_trainer, quick


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


@pytest.mark.parametrize("masked", [False, True])
def test_the_transmittance_loss_is_the_mean_over_what_the_mask_keeps(masked):
    transmittance = torch.rand(3, 5, dtype=torch.float64).requires_grad_()
    mask = torch.tensor([1.0, 0.5, 0.0]).double().view(3, 1, 1).expand(3, 5, 1) if masked else None
    empty = torch.zeros(0)
    rendering = Rendering(torch.zeros(3, 5, 3), transmittance, empty, empty, empty, 0)
    render = PhotoRender(None, None, None, rendering)
    weights = torch.ones(3, 5).double() if mask is None else mask[..., 0]
    transmittance_loss(render, replace(target_of(torch.zeros(3, 5, 3)), mask=mask), 0.2).backward()
    assert torch.allclose(transmittance.grad, 0.2 * weights / weights.sum())


def test_the_hdr_loss_compares_in_the_mu_law():
    exposure, truth = (4 * image for image in images())
    config = LossConfig(form="blend", hdr_weight=1.0)
    target = target_of(truth / 4, truth=truth, clipping=False)
    loss = hdr_loss(PhotoRender(exposure, exposure, exposure, None), target, config, 4.0)
    a, b = ((1 + 5000 * x / 4).log() / math.log1p(5000) for x in (exposure, truth))
    assert float(loss) == pytest.approx(float(0.8 * (a - b).abs().mean() + 0.2 * (1 - ssim(a, b))), rel=1e-4)


def test_weights_mix_photos_and_truth(scene):
    encoded, exposure = images(0)
    photo = PhotoRender(encoded, 4 * exposure, 4 * exposure, None)
    encoded, truth = images(1)
    target = target_of(encoded, truth=4 * truth, clipping=False)
    field = make_trainer(scene, quick()).field

    def loss(**weights):
        return float(data_loss(field, photo, target, LossConfig(clipping=False, **weights), 4.0))

    ldr, hdr = loss(), loss(ldr_weight=0.0, hdr_weight=1.0)
    assert loss(ldr_weight=2.0, hdr_weight=0.6) == pytest.approx(2 * ldr + 0.6 * hdr, rel=1e-5)
    # A view without truth has its photo alone.
    target = dataclasses.replace(target, exposure_truth=None)
    assert loss(hdr_weight=0.6) == pytest.approx(ldr)


def test_photos_of_no_weight_teach_nothing(scene):
    views = tuple(dataclasses.replace(view, codes=view.codes[::-1].copy()) for view in scene.views)
    config = quick("truth", **{"model.initial_density": 0.0, "mcmc.seed_fraction": 0.0})
    trainers = [make_trainer(scene, config), make_trainer(dataclasses.replace(scene, views=views), config)]
    for trainer in trainers:
        for _ in range(5):
            trainer.step()
    first, second = (trainer.field.gaussians.tensors() for trainer in trainers)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_the_anchor_holds_the_unit_exposure_of_a_learned_tone_mapper():
    mapper = ToneMapper(8, seed=1)
    loss = anchor_loss(mapper)
    expected = (mapper.encode(torch.ones(1, 3)) - 0.5).square().mean()
    assert loss.item() == pytest.approx(expected.item(), abs=1e-6)
    loss.backward()
    gradients = [parameter.grad for parameter in mapper.parameters() if parameter.grad is not None]
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert mapper.biases[-1].grad.abs().min() > 0
