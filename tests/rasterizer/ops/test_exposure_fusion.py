"""The fusion's kernels against NeuralExposureFusion's own torch operations."""

import pytest
import torch

from sehdr_warp.model.fusion import NeuralExposureFusion
from sehdr_warp.rasterizer.ops.exposure_fusion import _Fusion, fuse_exposures, fusion_weights
from sehdr_warp.response import response_by_name

from ..scenes import relative_error


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
    fuse = _Fusion.apply if by_kernels else lambda *tensors: fuse_exposures(*tensors[:-1], scale=tensors[-1])
    value = fuse(encoded.to(device, dtype), *parts(ours), 2.5)
    (value * upstream.to(device, dtype)).sum().backward()
    assert relative_error(value, truth) < bound
    for name, mine, true in zip(("sigma", "W", "b", "V", "c"), parts(ours), parts(plain), strict=True):
        assert mine.grad.shape == true.grad.shape
        assert relative_error(mine.grad, true.grad) < 10 * bound, name


def test_fused_light_on_the_cpu_does_not_depend_on_torchs_threads():
    generator = torch.Generator().manual_seed(0)
    ours = [torch.randn(part.shape, generator=generator) for part in parts(learned(torch.float32, width=128))]
    before, values = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 4, 8):
            torch.set_num_threads(threads)
            values.append([fuse_exposures(brackets(count).float(), *ours, scale=2.5) for count in (200, 1026)])
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    for others in values[1:]:
        assert all(map(torch.equal, others, values[0]))


def test_brackets_that_are_learned_have_gradients_too(device):
    encoded, ours = brackets().to(device), parts(learned(torch.float64, device))
    plain = fuse_exposures(encoded, *ours, scale=1.5)
    leaf = encoded.clone().requires_grad_()
    through = fuse_exposures(leaf, *ours, scale=1.5)
    through.sum().backward()
    assert relative_error(through, plain) < 1e-12 and bool((leaf.grad != 0).any())


def test_what_does_not_fit_is_refused(device):
    inputs = parts(learned(torch.float32, device))
    with pytest.raises(ValueError, match=r"encoded has shape \[3, 200, 2\]"):
        fuse_exposures(brackets().float().to(device)[..., :2], *inputs, scale=1.0)
    with pytest.raises(ValueError, match="log_sigma is torch.float32"):
        fuse_exposures(brackets().to(device), *inputs, scale=1.0)
