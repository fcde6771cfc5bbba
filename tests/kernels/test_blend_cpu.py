"""The CPU's blend and its backward pass against torch in float64."""

import pytest
import torch

from sehdr_warp.rasterizer.blending import blend
from sehdr_warp.rasterizer.projection import Splats2D
from sehdr_warp.rasterizer.reference import blend_reference
from sehdr_warp.rasterizer.tile_lists import build_tile_lists, order_gaussians

from ..rasterizer.scenes import packed, projected, random_like, random_scene, relative_error

BOUNDS = {torch.float64: 1e-12, torch.float32: 1e-5}


def crowd(channels, count=600, width=44, height=26):
    """A scene of so much overlap that pixels finish early; its picture has cut tiles at the right and the bottom."""
    return random_scene(count=count, channels=channels, width=width, height=height, spread=1.6, seed=2)


def leaves_and_lists(scene, threshold):
    """Return arguments of blend(): splats whose tensors are leaves, lists and packed Gaussians."""
    gaussians, splats = projected(scene, threshold), packed(scene, threshold)
    order = order_gaussians(splats)
    lists = build_tile_lists(splats, order, scene.width, scene.height, keep_emit_order=True)
    leaves = [tensor.detach().requires_grad_() for tensor in (*gaussians, scene.tensors[4])]
    return Splats2D(*leaves), lists, splats


def assert_blend_is_the_reference(scene, dtype, device, threshold=1 / 255, run=lambda task: task(), **options):
    """run: calls what launches kernels."""
    leaves, *arguments = leaves_and_lists(scene.to(dtype, device), threshold)
    image, transmittance = run(lambda: blend(leaves, *arguments, threshold, **options))
    true_leaves = leaves_and_lists(scene.to(torch.float64), threshold)[0]
    means2d, conics, depths, opacities, extents, features = true_leaves
    blended = means2d, conics, opacities, features, depths.detach(), extents.detach()
    true_image, true_transmittance = blend_reference(*blended, scene.width, scene.height, threshold)
    bound = BOUNDS[dtype]
    assert relative_error(image, true_image) < bound
    assert relative_error(transmittance, true_transmittance) < bound
    assert relative_error(1 - transmittance, 1 - true_transmittance) < bound
    loss = (image * random_like(image, 1)).sum() + (transmittance * random_like(transmittance, 2)).sum()
    run(loss.backward)
    true_loss = (true_transmittance * random_like(true_transmittance, 2)).sum()
    (true_loss + (true_image * random_like(true_image, 1)).sum()).backward()
    bound *= 10 if image.is_cuda else 1  # A GPU sums in any order.
    for name in ("means2d", "conics", "opacities", "features"):
        assert relative_error(getattr(leaves, name).grad, getattr(true_leaves, name).grad) < bound, name
    return transmittance


@pytest.mark.parametrize("dtype", BOUNDS, ids=["float64", "float32"])
@pytest.mark.parametrize("channels, threshold", [(1, 1 / 255), (3, 1 / 255), (9, 1 / 255), (3, 1e-9)])
def test_it_is_the_reference(dtype, channels, threshold):
    """Also where the exponential reaches far down."""
    assert (assert_blend_is_the_reference(crowd(channels), dtype, "cpu", threshold) < 0.001).any()


@pytest.mark.parametrize("light", [0.0, -1.0, 1e-30, 1e30])
def test_extreme_light_is_blended_in_numbers(light):
    scene = crowd(2, count=40)
    scene.tensors[3][::2] = 1.0  # No Gaussian hides all that is behind it.
    scene.tensors[4][:, 0] = light
    leaves, *arguments = leaves_and_lists(scene.to(torch.float32), 1 / 255)
    image, transmittance = blend(leaves, *arguments, 1 / 255)
    (image / max(1.0, abs(light))).sum().backward()
    torch.testing.assert_close(image[..., 0], light * (1 - transmittance), rtol=1e-5, atol=0)
    assert all(leaf.grad is None or leaf.grad.isfinite().all() for leaf in leaves)


def test_nothing_is_black():
    leaves, *arguments = leaves_and_lists(crowd(3, count=0).to(torch.float32), 1 / 255)
    image, transmittance = blend(leaves, *arguments, 1 / 255)
    (image.sum() + transmittance.sum()).backward()
    assert not image.any() and (transmittance == 1).all() and leaves.features.grad.shape == (0, 3)
