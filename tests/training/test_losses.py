"""Losses: forms, one-sidedness where the camera saturated, masks, and which side learns."""

from dataclasses import replace

import pytest
import torch

from sehdr_warp.field.radiance_field import Photograph
from sehdr_warp.response import ToneMapper, response_by_name
from sehdr_warp.splatting.ssim import ssim
from sehdr_warp.training.config import LossConfig
from sehdr_warp.training.losses import (
    CODE,
    Target,
    image_loss,
    ldr_loss,
    linear_loss,
    mu_law,
    mu_of_knee,
    one_sided,
)


def images(seed=0, shape=(12, 14, 3)):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)


def target_of(encoded, mask=None, truth=None):
    return Target(encoded, encoded >= 1 - CODE / 2, encoded <= CODE / 2, mask, truth)


@pytest.mark.parametrize("form,weights", [("sum", (1.0, 0.2)), ("blend", (0.8, 0.2))])
def test_forms(form, weights):
    a, b = images()
    expected = weights[0] * (a - b).abs().mean() + weights[1] * (1 - ssim(a, b))
    assert image_loss(a, b, None, form, 0.2).item() == pytest.approx(expected.item(), rel=1e-6)


def test_clipped_pixels_push_up_and_never_down():
    encoded = torch.tensor([1.0, 1.0, 0.5, 0.0, 0.0]).reshape(1, 5, 1).expand(1, 5, 3).contiguous()
    predicted = torch.tensor([1.4, 0.8, 0.9, 0.4 * CODE, 0.3]).reshape(1, 5, 1).expand(1, 5, 3).clone().requires_grad_()
    config = LossConfig(ssim_weight=0.0)
    ldr_loss(Photograph(predicted, None, None, None), target_of(encoded), config).backward()
    gradient = predicted.grad[0, :, 0]
    # Brighter than white and darker than half a code cost nothing; the rest is pulled toward the photo.
    assert gradient[0] == 0 and gradient[3] == 0
    assert gradient[1] < 0 and gradient[2] > 0 and gradient[4] > 0


def test_without_clipping_an_overshoot_costs():
    encoded, predicted = torch.ones(2, 2, 3), torch.full((2, 2, 3), 1.3, requires_grad=True)
    loss = ldr_loss(
        Photograph(predicted, None, None, None), target_of(encoded), LossConfig(ssim_weight=0.0, clipping=False)
    )
    assert loss.item() == pytest.approx(0.3, rel=1e-5)


def test_one_sided_keeps_the_black_hinge_continuous():
    target = target_of(torch.zeros(1, 1, 3))
    half = torch.full((1, 1, 3), CODE / 2)
    just_above = one_sided(half + 1e-6, target.encoded, target, (CODE / 2, CODE / 2))
    assert just_above.min() >= 0 and just_above.max() < 2e-6


def test_masked_pixels_cost_nothing():
    a, b = images()
    mask = torch.zeros(12, 14, 1)
    mask[:, :7] = 1
    changed = b.clone()
    changed[:, 7:] = 0.123
    assert image_loss(a, b, mask, "sum", 0.2) == image_loss(a, changed, mask, "sum", 0.2)
    expected = (a - b)[:, :7].abs().mean()
    assert image_loss(a, b, mask, "sum", 0.0).item() == pytest.approx(expected.item(), rel=1e-5)


def test_truth_supervises_the_base():
    base, truth = images(2)
    photo = Photograph(base, torch.zeros_like(base), base, None)
    config = LossConfig(linear_weight=0.5, hdr_truth=True)
    assert linear_loss(photo, target_of(truth, truth=base), config).item() == pytest.approx(0, abs=1e-6)
    assert linear_loss(photo, target_of(truth, truth=truth), config) > 0.1


def test_nothing_to_compare_without_fusion_and_truth():
    base, _ = images()
    assert linear_loss(Photograph(base, base, base, None), target_of(base), LossConfig()) is None


def photo_of(light, response):
    """A simulated photo of exposures [H, W, 3]."""
    return Photograph(response.encode_extended(light), light, light, None, light)


def quantised(encoded):
    return (encoded * 255).round() / 255


def test_auto_compares_exposures_where_there_are_some_and_the_curve_is_known():
    response = response_by_name("srgb")
    light = images(3)[0].double() * 0.8 + 0.05
    target, photo = target_of(quantised(response.encode(light))), photo_of(light, response)
    encoded = image_loss(photo.encoded, target.encoded, None, "sum", 0.2).item()
    assert ldr_loss(photo, target, LossConfig(), response).item() != encoded
    assert ldr_loss(replace(photo, light=None), target, LossConfig(), response).item() == encoded
    assert ldr_loss(photo, target, LossConfig(), ToneMapper(8)).item() == encoded


@pytest.mark.parametrize("name", ["srgb", "hdr-nerf"])
def test_photos_that_are_kept_decoded_give_the_same_loss(name):
    response = response_by_name(name)
    light = images(3)[0].double() * 2.5  # some of it clips, some is black
    light[:2] = 0
    encoded = quantised(response.encode(light))
    target = replace(target_of(encoded), clipped=encoded >= 1 - CODE / 2, black=encoded <= CODE / 2)
    photo = photo_of(light * 0.9 + 0.01, response)
    decoding = ldr_loss(photo, target, LossConfig(), response)
    keeping = ldr_loss(photo, replace(target, light=response.decode(encoded)), LossConfig(), response)
    assert keeping.item() == decoding.item() > 0


@pytest.mark.parametrize("domain", ["encoded", "mu-law"])
def test_saturated_pixels_are_one_sided_in_every_domain(domain):
    response = response_by_name("srgb")
    encoded = torch.tensor([1.0, 1.0, 0.0, 0.0]).reshape(1, 4, 1).expand(1, 4, 3).contiguous().double()
    light = torch.tensor([7.0, 0.8, 0.4 * CODE / 12.92, 0.01]).double().reshape(1, 4, 1).expand(1, 4, 3)
    light = light.clone().requires_grad_()
    photo = photo_of(light, response)
    photo = photo if domain == "mu-law" else replace(photo, light=None)
    ldr_loss(photo, target_of(encoded), LossConfig(ssim_weight=0.0), response).backward()
    gradient = light.grad[0, :, 0]
    assert gradient[0] == 0 and gradient[2] == 0 and gradient[1] < 0 and gradient[3] > 0


def test_gradients_of_the_photo_loss():
    response = response_by_name("hdr-nerf")
    generator = torch.Generator().manual_seed(4)
    target = target_of(quantised(torch.rand(4, 5, 3, generator=generator, dtype=torch.float64)))
    light = (torch.rand(4, 5, 3, generator=generator, dtype=torch.float64) + 0.1).requires_grad_()
    config = LossConfig()
    assert torch.autograd.gradcheck(
        lambda x: ldr_loss(photo_of(x, response), target, config, response), light, eps=1e-7, atol=1e-6
    )


def test_the_mu_law_weighs_shadows_as_the_metric_does():
    response = response_by_name("hdr-nerf")
    light = torch.tensor([1e-3, 1.0]).double().reshape(1, 2, 1).expand(1, 2, 3)
    target = target_of(response.encode(light))
    config = LossConfig(ssim_weight=0.0)
    loss = ldr_loss(photo_of(2 * light, response), target, config, response)
    mu = mu_of_knee(response)
    expected = (mu_law(2 * light, response.white, mu) - mu_law(light, response.white, mu)).mean()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-6)


@pytest.mark.parametrize("name", ["srgb", "hdr-nerf", "linear"])
def test_the_knee_is_at_its_code(name):
    response = response_by_name(name)
    knee = response.white / mu_of_knee(response)
    assert float(response.encode(knee)) * 255 == pytest.approx(8.0, rel=1e-6)
