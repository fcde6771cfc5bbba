"""Absolute gradients of 2D means against torch's own of each pixel, in float64."""

import pytest
import torch

from sehdr_warp.rasterizer.absolute_gradient import watch_absolute_gradients
from sehdr_warp.rasterizer.reference import blend_reference
from sehdr_warp.rasterizer.tile_lists import build_tile_lists, order_gaussians

from ..rasterizer.scenes import packed, projected, random_like, random_scene, relative_error

THRESHOLD, WIDTH, HEIGHT = 1 / 255, 19, 4


def absolute_gradients(scene, weights, by_transmittance, *, in_order=True):
    splats = packed(scene)
    order = order_gaussians(splats, keep_emit_order=in_order)
    lists = build_tile_lists(splats, order, WIDTH, HEIGHT, keep_emit_order=in_order)
    image, transmittance = (tensor.clone().requires_grad_() for tensor in (weights, by_transmittance))
    results = []
    outputs = watch_absolute_gradients(image, transmittance, scene.tensors[4], lists, splats, THRESHOLD, results.append)
    torch.autograd.backward(outputs, (weights, by_transmittance))
    assert torch.equal(image.grad, weights) and torch.equal(transmittance.grad, by_transmittance)
    return results[0]


@pytest.mark.parametrize("in_order", [True, False])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_they_are_sums_over_pixels(device, dtype, bound, in_order):
    if not in_order and device == "cpu":
        pytest.skip("sums of a CPU are in order")
    scene = random_scene(count=30, channels=2, width=WIDTH, height=HEIGHT, spread=1.0, seed=1)
    scene.tensors[3][:5] = 1.0  # Held at the most that a Gaussian hides, without a slope
    means2d, conics, depths, opacities, extents = projected(scene)
    means2d.requires_grad_()
    blended = blend_reference(means2d, conics, opacities, scene.tensors[4], depths, extents, WIDTH, HEIGHT, THRESHOLD)
    weights = [random_like(tensor, seed) for seed, tensor in enumerate(blended)]
    by_pixel = (blended[0] * weights[0]).sum(-1) + blended[1] * weights[1]
    truth = sum(torch.autograd.grad(pixel, means2d, retain_graph=True)[0].abs() for pixel in by_pixel.flatten())
    assert (blended[1] < 1e-3).any() and (truth > 0).sum() > 20
    ours = absolute_gradients(
        scene.to(dtype, device), *(tensor.to(device, dtype) for tensor in weights), in_order=in_order
    )
    assert relative_error(ours, truth) < bound


@pytest.mark.parametrize("count", [0, 9])
@pytest.mark.parametrize("upstream", [0.0, 1e-30, 1e30])
def test_extreme_gradients_stay_numbers(device, count, upstream):
    scene = random_scene(count=count, channels=2, width=WIDTH, height=HEIGHT).to(torch.float32, device)
    weights = torch.full((HEIGHT, WIDTH, 2), upstream, device=device)
    ours = absolute_gradients(scene, weights, weights[..., 0].contiguous())
    assert ours.shape == (count, 2) and ours.isfinite().all() and bool(ours.any()) == (count > 0 and upstream > 0)
