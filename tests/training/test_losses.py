"""Losses: forms, one-sidedness where the camera saturated, masks, and which side learns."""

from dataclasses import replace

import pytest
import torch

from sehdr_warp.field.radiance_field import CameraTensors, Photograph
from sehdr_warp.response import ToneMapper, response_by_name
from sehdr_warp.response.refined import RefinedResponse
from sehdr_warp.splatting.ssim import ssim
from sehdr_warp.training.config import LossConfig
from sehdr_warp.training.losses import (
    CODE,
    Target,
    data_loss,
    highlight_prior,
    image_loss,
    ldr_loss,
    linear_loss,
    mu_law,
    mu_of_knee,
    one_sided,
    regularised,
)

from .toy import orbit_camera, toy_field


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
    just_above = one_sided(half + 1e-6, target.encoded, target, -half, half, False)
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


@pytest.mark.parametrize("detach,learns", [("fused", (True, False)), ("base", (False, True)), ("none", (True, True))])
def test_the_detached_side_does_not_learn(detach, learns):
    base, fused = (image.requires_grad_() for image in images(1))
    photo = Photograph(fused, fused, base, None)
    linear_loss(photo, target_of(torch.zeros(12, 14, 3)), LossConfig(linear_detach=detach)).backward()
    assert (base.grad is not None, fused.grad is not None) == learns


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


@pytest.mark.parametrize("domain", ["encoded", "mu-law"])
@pytest.mark.parametrize("response", [response_by_name("srgb"), response_by_name("hdr-nerf")], ids=str)
def test_an_interval_costs_nothing_inside_and_pulls_outside(domain, response):
    generator = torch.Generator().manual_seed(2)
    light = torch.rand(12, 14, 3, generator=generator, dtype=torch.float64) * 0.9 + 0.002
    target = target_of(quantised(response.encode(light)))
    plain = LossConfig(domain=domain)
    inside = LossConfig(domain=domain, interval="all")
    # The truth lies within half a code of its photo, by what rounding is.
    assert ldr_loss(photo_of(light, response), target, inside, response) == pytest.approx(0, abs=1e-12)
    assert ldr_loss(photo_of(light, response), target, plain, response) > 1e-4
    darker = (0.9 * light).requires_grad_()
    difference = LossConfig(domain=domain, interval="all", ssim_weight=0.0)
    ldr_loss(photo_of(darker, response), target, difference, response).backward()
    codes = 255 * (target.encoded - response.encode(darker.detach()))
    assert (darker.grad[codes > 0.51] < 0).all() and (darker.grad[codes < 0.49] == 0).all()


def test_an_interval_of_the_difference_leaves_ssim_alone():
    response = response_by_name("srgb")
    light = images(3)[0].double() * 0.8 + 0.05
    target, photo = target_of(quantised(response.encode(light))), photo_of(light, response)
    loss = ldr_loss(photo, target, LossConfig(interval="difference", domain="encoded"), response)
    expected = 0.2 * (1 - ssim(photo.encoded, target.encoded))
    assert loss.item() == pytest.approx(expected.item(), rel=1e-6) and loss > 0


def test_auto_compares_exposures_where_there_are_some_and_the_curve_is_known():
    response = response_by_name("srgb")
    light = images(3)[0].double() * 0.8 + 0.05
    target, photo = target_of(quantised(response.encode(light))), photo_of(light, response)
    by_domain = {
        domain: ldr_loss(photo, target, LossConfig(domain=domain), response).item() for domain in ("encoded", "mu-law")
    }
    assert by_domain["encoded"] != by_domain["mu-law"]
    assert LossConfig().domain == "auto"
    assert ldr_loss(photo, target, LossConfig(), response).item() == by_domain["mu-law"]
    assert ldr_loss(replace(photo, light=None), target, LossConfig(), response).item() == by_domain["encoded"]
    assert ldr_loss(photo, target, LossConfig(), ToneMapper(8)).item() == by_domain["encoded"]


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


@pytest.mark.parametrize("interval", ["off", "difference", "all"])
@pytest.mark.parametrize("domain", ["encoded", "mu-law"])
def test_saturated_pixels_are_one_sided_in_every_domain(domain, interval):
    response = response_by_name("srgb")
    encoded = torch.tensor([1.0, 1.0, 0.0, 0.0]).reshape(1, 4, 1).expand(1, 4, 3).contiguous().double()
    light = torch.tensor([7.0, 0.8, 0.4 * CODE / 12.92, 0.01]).double().reshape(1, 4, 1).expand(1, 4, 3)
    light = light.clone().requires_grad_()
    config = LossConfig(domain=domain, interval=interval, ssim_weight=0.0)
    ldr_loss(photo_of(light, response), target_of(encoded), config, response).backward()
    gradient = light.grad[0, :, 0]
    assert gradient[0] == 0 and gradient[2] == 0 and gradient[1] < 0 and gradient[3] > 0


@pytest.mark.parametrize("interval", ["off", "difference", "all"])
@pytest.mark.parametrize("domain", ["encoded", "mu-law"])
def test_gradients_of_the_photo_loss(domain, interval):
    response = response_by_name("hdr-nerf")
    generator = torch.Generator().manual_seed(4)
    target = target_of(quantised(torch.rand(4, 5, 3, generator=generator, dtype=torch.float64)))
    light = (torch.rand(4, 5, 3, generator=generator, dtype=torch.float64) + 0.1).requires_grad_()
    config = LossConfig(domain=domain, interval=interval)
    assert torch.autograd.gradcheck(
        lambda x: ldr_loss(photo_of(x, response), target, config, response), light, eps=1e-7, atol=1e-6
    )


def test_the_mu_law_weighs_shadows_as_the_metric_does():
    response = response_by_name("hdr-nerf")
    light = torch.tensor([1e-3, 1.0]).double().reshape(1, 2, 1).expand(1, 2, 3)
    target = target_of(response.encode(light))
    config = LossConfig(domain="mu-law", ssim_weight=0.0)
    loss = ldr_loss(photo_of(2 * light, response), target, config, response)
    mu = mu_of_knee(response, config.knee)
    expected = (mu_law(2 * light, response.white, mu) - mu_law(light, response.white, mu)).mean()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-6)
    # Of a doubling of both, the dark one costs a smaller part the higher the knee is.
    shares = []
    for knee in (2.0, 100.0):
        dark = light * torch.tensor([2.0, 1.0]).double().reshape(1, 2, 1)
        options = LossConfig(domain="mu-law", knee=knee, ssim_weight=0.0)
        both = ldr_loss(photo_of(2 * light, response), target, options, response)
        shares.append((ldr_loss(photo_of(dark, response), target, options, response) / both).item())
    assert shares[0] > 2 * shares[1] > 0


def test_the_highlight_prior_lifts_clipped_pixels_and_hardly_holds_them_down():
    light = torch.tensor([0.5, 1.5, 4.0, 4.0]).double().reshape(1, 4, 1).expand(1, 4, 3).clone().requires_grad_()
    clipped = torch.tensor([True, True, True, False]).reshape(1, 4, 1).expand(1, 4, 3)
    loss = highlight_prior(light, clipped, 1.0, torch.tensor([9.0, 9.0, 9.0, 1.0]))
    # 1 - log2(1.5) stops short of one stop over white, and one stop beyond it, which counts a tenth.
    assert loss.item() == pytest.approx((0.4150375 + 0.1) / 4, rel=1e-6)
    loss.backward()
    gradient = light.grad[0, :, 0]
    assert gradient[0] == 0 and gradient[3] == 0
    # A stop is ln 2 times the exposure: 1.5 and 4.
    assert float(gradient[2] / -gradient[1]) == pytest.approx(0.1 * 1.5 / 4)
    assert highlight_prior(light, None, 1.0, torch.ones(4)) == 0
    assert highlight_prior(light, clipped, 1.0, None) == 0


def test_the_highlight_prior_expects_more_where_more_channels_clip():
    light = torch.full((1, 3, 3), 4.0).double()
    clipped = torch.tensor([[[True, False, False], [True, True, False], [True, True, True]]])
    # Two stops over white, in one, two and three channels of nine.
    expected = torch.tensor([9.0, 3.5, 3.0, 2.25])
    assert highlight_prior(light, clipped, 1.0, expected).item() == pytest.approx((1.5 + 2 * 1.0 + 3 * 0.25) / 9)
    mask = torch.tensor([0.0, 1.0, 0.0]).double().reshape(1, 3, 1)
    assert highlight_prior(light, clipped, 1.0, expected, mask).item() == pytest.approx(2 * 1.0 / 3)


def test_priors_and_regularisers_add_what_they_weigh():
    field = toy_field()
    field.gaussians.harmonics_rest = torch.nn.Parameter(torch.full((field.gaussians.count, 3, 3), 0.5))
    camera = CameraTensors.of(orbit_camera(0.3), "cpu")
    photo = field.photograph(camera, 4 * field.base_time)
    expected = torch.tensor([0.0, 0.1, 0.3, 0.5])
    target = replace(target_of(photo.encoded.detach().clamp(0, 1)), highlights=expected)

    def loss(**weights):
        config = LossConfig(**weights)
        return regularised(data_loss(field, photo, target, config), field, config).item()

    plain = loss()
    assert loss(harmonics_weight=2.0) - plain == pytest.approx(0.5, rel=1e-4)
    prior = highlight_prior(photo.light, target.clipped, field.response.white, expected).item()
    assert prior > 0
    assert loss(highlight_weight=3.0) - plain == pytest.approx(3 * prior, rel=1e-3)


def test_the_mu_law_domain_teaches_a_refined_response():
    start = response_by_name("srgb")
    refined, light = RefinedResponse(start), images(5)[0] * 1.2 + 0.01
    target, config = target_of(quantised(start.encode(images(6)[0]))), LossConfig(domain="mu-law")
    losses, gradients = [], []
    for response in (start, refined):
        given = light.clone().requires_grad_()
        loss = ldr_loss(photo_of(given, response), target, config, response)
        loss.backward()
        losses.append(loss.item())
        gradients.append(given.grad)
    # At its start a refined response is the curve itself, above white too.
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    torch.testing.assert_close(*gradients, rtol=1e-2, atol=1e-7)
    assert refined.log_densities.grad.abs().sum() > 1e-4


@pytest.mark.parametrize("name", ["srgb", "hdr-nerf", "linear"])
def test_the_knee_is_at_its_code(name):
    response = response_by_name(name)
    knee = response.white / mu_of_knee(response, 8.0)
    assert float(response.encode(knee)) * 255 == pytest.approx(8.0, rel=1e-6)
