"""Light where a photo clips: the kernel against torch's own operations, and finite differences."""

import numpy as np
import pytest
import torch
import warp as wp

from sehdr_warp.kernels.clipped_light import REACH
from sehdr_warp.rasterizer.losses import patches
from sehdr_warp.rasterizer.losses.code_residual import code_tensor
from sehdr_warp.rasterizer.losses.photo_loss import ClippedWeights, clipped_light_energy

from ..rasterizer.scenes import relative_error

WHITE, WEIGHTS = 1.3, ClippedWeights(smoothness=0.7, estimate=0.4)


@pytest.fixture(params=["values", "patches"])
def kernels(request, monkeypatch, device):
    """The kernels of the device; on the CPU those of a GPU too, in Warp's block emulation."""
    if request.param == "patches" and device == "cpu":
        monkeypatch.setattr(patches, "in_patches", lambda device: True)
        monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    elif device != "cpu" and request.param != "patches":
        pytest.skip("kernels of the CPU")


def clipped_photo(bits=8):
    """Light [40, 37, 3] around white, a photo's codes with clipped disks, a clipped corner and a clipped speck."""
    generator = torch.Generator().manual_seed(3)
    light = WHITE * torch.exp(torch.randn(40, 37, 3, generator=generator, dtype=torch.float64))
    y, x = np.mgrid[:40, :37]
    clipped = ((y - 6) ** 2 + (x - 9) ** 2 < 12) | ((y - 31) ** 2 + (x - 32) ** 2 < 20)
    clipped |= (y + x < 4) | ((y == 1) & (x == 15))
    codes = np.where(clipped[..., None] & np.array([True, True, False]), 2**bits - 1, 100)
    codes[5:8, 8:11, 2] = 2**bits - 1
    return light, codes.astype(np.uint16 if bits == 16 else np.uint8)


def some_estimates():
    """Estimates [9, 11, 6] for the photo, which know nothing of a part of it."""
    generator = torch.Generator().manual_seed(5)
    estimates = torch.rand(9, 11, 6, generator=generator)
    estimates[:3, :3, 3:] = 0
    return estimates.half()


def reference(light, codes, mask=None, means_of=None, estimates=None):
    """Pixel by pixel. means_of: the light that the means are of, by default the same, held as it is."""
    clipped = (codes == np.iinfo(codes.dtype).max) & (True if mask is None else mask.numpy() > 0)
    logs, others = ((x / WHITE).clamp_min(1).log() for x in (light, (light if means_of is None else means_of).detach()))
    total = torch.zeros((), dtype=light.dtype)
    for y, x, channel in np.argwhere(clipped):
        around = np.s_[max(y - REACH, 0) : y + REACH + 1, max(x - REACH, 0) : x + REACH + 1, channel]
        near, value = torch.from_numpy(clipped[around]), logs[y, x, channel]
        total = total + WEIGHTS.smoothness / 2 * (value - others[around][near].mean()) ** 2
        if estimates is not None:
            rows, columns = estimates.shape[:2]
            estimate = estimates[y * rows // light.shape[0], x * columns // light.shape[1]].double()
            # Light below white counts as white and is held all the same.
            above = light[y, x, channel] / WHITE
            value = value if above > 1 else above - above.detach()
            total = total + WEIGHTS.estimate / 2 * (estimate[channel + 3] * (value - estimate[channel])) ** 2
    return total / light.numel()


@pytest.mark.parametrize("estimated", [False, True])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_values_and_gradients_are_those_of_torch(device, kernels, bits, dtype, bound, estimated):
    light, codes = clipped_photo(bits)
    reference_light = light.clone().requires_grad_()
    estimates = some_estimates() if estimated else None
    expected = reference(reference_light, codes, estimates=estimates)
    (3 * expected).backward()
    ours = light.to(device, dtype).requires_grad_()
    options = {"estimates": estimates.to(device) if estimated else None}
    energy = clipped_light_energy(ours, code_tensor(codes, device), WHITE, WEIGHTS, **options)
    (3 * energy).backward()
    assert relative_error(energy, expected) < bound
    assert relative_error(ours.grad, reference_light.grad) < bound
    stack, index = code_tensor(np.stack([codes[::-1], codes]), device), torch.tensor([1], device=device)
    assert torch.equal(clipped_light_energy(ours, stack, WHITE, WEIGHTS, index=index, **options), energy)


def test_gradient_is_that_of_finite_differences(device, kernels):
    light, codes = clipped_photo()
    image = light.to(device).requires_grad_()
    clipped_light_energy(image, code_tensor(codes, device), WHITE, WEIGHTS).backward()
    step, generator = 1e-5, np.random.default_rng(0)
    for place in generator.permutation(np.argwhere(codes == 255))[:12]:
        ends = []
        for sign in (1, -1):
            moved = light.clone()
            moved[tuple(place)] += sign * step
            ends.append(reference(moved, codes, means_of=light).item())
        assert image.grad[tuple(place)].item() == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5, abs=1e-11)


def test_masked_pixels_are_not_clipped(device, kernels):
    light, codes = clipped_photo()
    mask = torch.ones(40, 37, 1, dtype=torch.float64)
    mask[4:7] = 0
    photo = code_tensor(codes, device)
    energy = clipped_light_energy(light.to(device), photo, WHITE, WEIGHTS, mask=mask.to(device))
    assert relative_error(energy, reference(light, codes, mask)) < 1e-12
    assert relative_error(energy, reference(light, codes)) > 1e-2


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_extreme_light_leaves_numbers(device, kernels, scale):
    light, codes = clipped_photo()
    image = (light * scale).to(device, torch.float32).requires_grad_()
    energy = clipped_light_energy(image, code_tensor(codes, device), WHITE, WEIGHTS)
    energy.backward()
    assert torch.isfinite(energy) and torch.isfinite(image.grad).all()
