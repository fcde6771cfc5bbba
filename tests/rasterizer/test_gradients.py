"""Layout of gradients that kernels read, and scalars that gradients share."""

import pytest
import torch

from sehdr_warp.rasterizer import gradients, ssim


@pytest.mark.parametrize("change", [lambda t: t, lambda t: t[::2], lambda t: t[:, :1], lambda t: t.mT.contiguous().mT])
def test_gradients_of_any_strides_have_rows_that_kernels_read(device, change):
    values = torch.arange(24.0, device=device).view(6, 4)
    for gradient in (change(values), torch.complex(values, values).conj().imag):
        read = gradients.kernel_layout(gradient)
        assert torch.equal(read, gradient) and read.stride(1) == 1 and not read.is_neg()


def test_a_shared_1_multiplies_nothing(device):
    gradient = torch.rand(5, device=device)
    assert gradients.scale_gradient(gradient, gradients.unit_gradient(gradient)) is gradient
    assert torch.equal(gradients.scale_gradient(gradient, torch.tensor(2.0, device=device)), 2 * gradient)


def test_a_first_call_in_inference_mode_leaves_nothing_that_gradients_cannot_use():
    gradients.constant.cache_clear()
    images = [torch.rand(12, 12, 3, requires_grad=True) for _ in range(2)]
    with torch.inference_mode():
        value = ssim(*images)
    assert torch.equal(ssim(*images), value) and not gradients.unit_gradient(value).is_inference()
    ssim(*images).backward()
    assert images[0].grad.isfinite().all()
