"""The fusion's kernels against NeuralExposureFusion's own torch operations."""

import pytest
import torch

from sehdr_warp.model.fusion import NeuralExposureFusion
from sehdr_warp.rasterizer.ops.exposure_fusion import fuse_by_kernels, fuse_exposures, fusion_weights
from sehdr_warp.response import response_by_name

from ..rasterizer.scenes import relative_error


def learned(dtype, device="cpu", width=24, sigmas=(-1.6, -0.4, 0.5)):
    fusion = NeuralExposureFusion(response_by_name("srgb"), (0.125, 0.5, 4.0), 0.5, width=width, radiance_scale=2.5)
    with torch.no_grad():
        fusion.log_sigma.copy_(torch.tensor(sigmas))
    return fusion.to(device, dtype)


def parts(fusion):
    (inner, outer), (inner_bias, outer_bias) = fusion.weights, fusion.biases
    return fusion.log_sigma, inner, inner_bias, outer, outer_bias


def brackets(count=200):
    return 1.3 * torch.rand(3, count, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)


# The last: within the limits' reach, where deviations are held and pull no longer.
@pytest.mark.parametrize("sigmas", [(-1.6, -0.4, 0.5), (-4.0, 31.0, -31.0)])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("by_kernels", [False, True])
def test_values_and_gradients_are_those_of_torch_in_float64(device, by_kernels, dtype, bound, sigmas):
    encoded = brackets()
    upstream = torch.randn(200, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    plain, ours = learned(torch.float64, sigmas=sigmas), learned(dtype, device, sigmas=sigmas)
    truth = 2.5 * (fusion_weights(encoded, *parts(plain)) * encoded).sum(0)
    (truth * upstream).sum().backward()
    fuse = fuse_by_kernels if by_kernels else lambda *tensors: fuse_exposures(*tensors[:-1], scale=tensors[-1])
    value = fuse(encoded.to(device, dtype), *parts(ours), 2.5)
    (value * upstream.to(device, dtype)).sum().backward()
    assert relative_error(value, truth) < bound
    for name, mine, true in zip(("sigma", "W", "b", "V", "c"), parts(ours), parts(plain), strict=True):
        assert mine.grad.shape == true.grad.shape
        assert relative_error(mine.grad, true.grad) < 10 * bound, name


@pytest.mark.parametrize("light", [0.0, -1e30, 1e30, 1e38])
def test_extreme_brackets_leave_numbers(device, light):
    encoded, ours = brackets(5).float().to(device), parts(learned(torch.float32, device))
    encoded[:, 2] = light
    value = fuse_by_kernels(encoded, *ours, 1.0)
    value[2].sum().backward()
    assert value.isfinite().all() and all(part.grad.isfinite().all() for part in ours)
    truth = fuse_exposures(encoded.cpu(), *parts(learned(torch.float32)), scale=1.0)
    torch.testing.assert_close(value.cpu(), truth)


def test_no_points_have_no_light(device):
    ours = parts(learned(torch.float32, device))
    fuse_by_kernels(brackets(0).float().to(device), *ours, 1.0).sum().backward()
    assert not any(part.grad.any() for part in ours)
