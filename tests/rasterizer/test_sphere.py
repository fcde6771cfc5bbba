"""Caps of tiles and gradients of the position; what pictures of the sphere show is compared in tests/kernels."""

import pytest
import torch

from sehdr_warp.rasterizer import projection, rasterize_directions, sphere
from sehdr_warp.rasterizer.sphere import caps_of

from ..kernels.test_sphere import FOCAL, gaussians, latlong
from .scenes import random_like, relative_error


def test_caps_hold_their_directions():
    directions = latlong(50)
    for side in (16, 128):
        caps = caps_of(directions, side)
        columns = -(-50 // side)
        for y, x in ((0, 0), (24, 49), (13, 31)):
            axis, (cosine, sine) = (tensor[(y // side) * columns + x // side] for tensor in caps)
            angle = float(torch.atan2(sine, cosine))
            assert float(torch.dot(axis, directions[y, x]).clamp(-1, 1).acos()) <= angle + 1e-9


def test_some_tiles_after_others_are_as_all_at_once(monkeypatch):
    scene, directions = gaussians(dtype=torch.float32), latlong(200, dtype=torch.float32)

    def pictures(tiles: int) -> list[torch.Tensor]:
        monkeypatch.setattr(sphere, "TILES_AT_ONCE", tiles)
        tensors = [tensor.clone().requires_grad_() for tensor in scene]
        image, left = rasterize_directions(*tensors, torch.zeros(3), directions, focal_length=FOCAL)
        (image.sum() + left.square().sum()).backward()
        return [image, left, *(tensor.grad for tensor in tensors)]

    assert all(map(torch.equal, pictures(5), pictures(2048)))


@pytest.mark.parametrize("count", [0, 1, 300])
@pytest.mark.parametrize("antialiased", [False, True])
def test_summed_gradients_of_each_gaussians_own_position_are_those_of_a_shared_one(
    device, count, antialiased, monkeypatch
):
    scene, directions = gaussians(count, device=device), latlong(device=device)
    tensors = [tensor.requires_grad_() for tensor in (*scene, torch.tensor([0.3, -0.2, 0.1], device=device).double())]

    def gradients():
        image, left = rasterize_directions(*tensors, directions, focal_length=FOCAL, antialiased=antialiased)
        return torch.autograd.grad((image * random_like(image, 1)).sum() + left.square().sum(), tensors)

    rows, zero_gradients = [], projection.zero_gradients
    kernels, projection_kernel = [], sphere.projection_kernel

    def watch(tensors, needed):
        gradients = zero_gradients(tensors, needed)
        rows.append(gradients[4].shape)
        return gradients

    def watch_kernel(*kind):
        kernels.append(kind[-1])
        return projection_kernel(*kind)

    monkeypatch.setattr(projection, "zero_gradients", watch)
    monkeypatch.setattr(sphere, "projection_kernel", watch_kernel)
    pair = []
    for in_any_order in (False, True):
        monkeypatch.setattr(projection, "adds_in_any_order", lambda device, answer=in_any_order: answer)
        pair.append(gradients())
    assert rows == [(3,), (count, 3)] and kernels == [False, True]
    for mine, true in zip(*pair, strict=True):
        assert mine.shape == true.shape and bool(true.any()) == (count > 0)
        assert relative_error(mine, true) < 1e-11
