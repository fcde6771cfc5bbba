"""Scenes in gsplat's arguments, for the tests here."""

from typing import NamedTuple

import torch

WIDTH, HEIGHT, COUNT = 40, 30, 200


class Place(NamedTuple):
    """Cameras as gsplat's rasterization() names them."""

    viewmats: torch.Tensor
    Ks: torch.Tensor
    width: int
    height: int


def scene(device="cpu", count=COUNT, coefficients=0):
    """gsplat's arguments: two cameras before a cloud of Gaussians."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.rand(*shape, generator=generator)

    colors = random(count, coefficients, 3) - 0.5 if coefficients else random(count, 3)
    quaternions = torch.randn(count, 4, generator=generator)
    values = [random(count, 3) * 2 - 1, quaternions, 0.05 + 0.1 * random(count, 3), random(count), colors]
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, 2, 3] = torch.tensor([3.0, 4.0])
    lenses = torch.tensor([[40.0, 0, 20], [0, 42.0, 15], [0, 0, 1]]).repeat(2, 1, 1)
    leaves = [tensor.to(device).requires_grad_() for tensor in values]
    return leaves, Place(poses.to(device), lenses.to(device), WIDTH, HEIGHT)


def gradients(colors, leaves):
    for leaf in leaves:
        leaf.grad = None
    weights = torch.rand(colors.shape, generator=torch.Generator().manual_seed(3)).to(colors)
    (colors * weights).sum().backward()
    return [leaf.grad.clone() for leaf in leaves]
