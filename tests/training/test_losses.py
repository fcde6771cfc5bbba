"""Losses: forms, one-sidedness where the camera saturated, masks, and which side learns."""

import pytest
import torch

from sehdr_warp.model.radiance_field import Photograph
from sehdr_warp.splatting.ssim import ssim
from sehdr_warp.training.config import LossConfig
from sehdr_warp.training.losses import CODE, Target, image_loss, ldr_loss, linear_loss, one_sided


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
    just_above = one_sided(torch.full((1, 1, 3), CODE / 2 + 1e-6), target)
    assert just_above.max() < 2e-6


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
