"""One-sided comparison by the mu-law: the kernel against the loss's own torch operations and finite differences."""

import pytest
import torch

from sehdr_warp.splatting.one_sided import seen_by_photo
from sehdr_warp.training.losses import Target, mu_law, one_sided

from .scenes import relative_error

WHITE, MU, HALF_CODES = 1.3, 300.0, (0.01, 0.03)


def images(dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    light = torch.rand(20, 30, 3, generator=generator, dtype=torch.float64) ** 3 * 2
    photo = (light + 0.1 * torch.randn(light.shape, generator=generator, dtype=torch.float64)).clamp(0, WHITE)
    light[0] = 1e-7 * light[0]  # where 1 + x would lose every digit
    light[1] = 0
    return light, photo, photo > 0.7 * WHITE, photo < 0.05 * WHITE


def reference(light, photo, clipped, black):
    value, truth = (mu_law(image, WHITE, MU) for image in (light, photo))
    target = Target(photo, clipped, black, None, None)
    return one_sided(value, truth, target, HALF_CODES), truth


@pytest.mark.parametrize(("has_clipped", "has_black"), [(True, True), (True, False), (False, True), (False, False)])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 2e-6), (torch.float64, 1e-13)])
def test_values_and_gradients_are_those_of_torch(device, has_clipped, has_black, dtype, bound):
    light, photo, clipped, black = images()
    masks = clipped if has_clipped else None, black if has_black else None
    weights = torch.randn(light.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    truth_light = light.clone().requires_grad_()
    truth, truth_of_photo = reference(truth_light, photo, *masks)
    (truth * weights).sum().backward()
    ours_light = light.to(device, dtype).requires_grad_()
    placed = [None if mask is None else mask.to(device) for mask in masks]
    seen, told = seen_by_photo(ours_light, photo.to(device, dtype), *placed, white=WHITE, mu=MU, half_codes=HALF_CODES)
    (seen * weights.to(device, dtype)).sum().backward()
    assert relative_error(seen, truth) < bound
    assert relative_error(seen[0], truth[0]) < bound
    assert relative_error(told, truth_of_photo) < bound
    assert relative_error(ours_light.grad, truth_light.grad) < bound
    assert not told.requires_grad


def test_gradients_match_finite_differences(device):
    light, photo, clipped, black = (image[2:4, :9].contiguous().to(device) for image in images())
    options = {"white": WHITE, "mu": MU, "half_codes": HALF_CODES}
    assert torch.autograd.gradcheck(
        lambda x: seen_by_photo(x, photo, clipped, black, **options)[0], light.clone().requires_grad_()
    )


def test_poison_stays_where_it_is(device):
    light = torch.tensor([float("nan"), float("inf"), 1.0], device=device)
    seen, _ = seen_by_photo(light, torch.ones(3, device=device), None, None, white=1.0, mu=9.0, half_codes=(0.1, 0.1))
    assert seen[0].isnan() and seen[1].isinf()
    assert seen[2].item() == pytest.approx(1.0)


def test_what_does_not_fit_is_refused(device):
    image = torch.zeros(4, 3, device=device)
    options = {"white": 1.0, "mu": 9.0, "half_codes": (0.1, 0.1)}
    with pytest.raises(ValueError, match=r"photo_light is torch.float32 \[2, 3\]"):
        seen_by_photo(image, image[:2], None, None, **options)
    with pytest.raises(ValueError, match="clipped is torch.float32"):
        seen_by_photo(image, image, image, None, **options)
