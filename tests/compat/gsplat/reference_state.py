"""Compute what gsplat's DefaultStrategy collects of a step, by autograd over every pixel and Gaussian in float64."""

from typing import NamedTuple

import torch
from torch import Tensor

from .scenes import Place

ALPHA_THRESHOLD, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4
EPS2D, NEAR_PLANE, MARGIN = 0.3, 0.01, 0.3


class ReferenceState(NamedTuple):
    """The strategy's sums by Gaussian.

    Attributes:
        grad2d: [N] lengths of the gradients by the 2D mean, in half images times cameras.
        count: [N] views that show it.
        radii: [N] largest radius as a part of the longer side.
    """

    grad2d: Tensor
    count: Tensor
    radii: Tensor

    def after(self, other: "ReferenceState") -> "ReferenceState":
        """Return the sums of both."""
        return ReferenceState(
            self.grad2d + other.grad2d, self.count + other.count, torch.maximum(self.radii, other.radii)
        )


class Splats(NamedTuple):
    """2D Gaussians of a camera: centres [N, 2], covariances [N, 2, 2], depths [N]."""

    centres: Tensor
    covariances: Tensor
    depths: Tensor


def reference_state(shapes: list[Tensor], colors: Tensor, place: Place, *, absgrad: bool) -> ReferenceState:
    """Return the state after one step whose loss is the mean of |image - 0.5| over all cameras.

    shapes: means, quats, scales and opacities as rasterization() takes them.
    """
    means, quats, scales, opacities = shapes
    width, height, cameras = place.width, place.height, len(place.viewmats)
    state = ReferenceState(*(means.new_zeros(len(means)) for _ in range(3)))
    for viewmat, K in zip(place.viewmats, place.Ks, strict=True):
        splats = _project(means, quats, scales, viewmat, K, width, height)
        variances = splats.covariances.diagonal(dim1=1, dim2=2)
        extents = ((2 * (opacities / ALPHA_THRESHOLD).clamp_min(1).log())[:, None] * variances).sqrt()
        size = means.new_tensor([width, height])
        inside = ((splats.centres + extents > 0) & (splats.centres - extents < size)).all(1)
        visible = inside & (splats.depths > NEAR_PLANE) & (opacities > ALPHA_THRESHOLD)
        # A centre for each pixel, so that every pixel's gradient is seen alone.
        centres = splats.centres.repeat(width * height, 1, 1).requires_grad_()
        image = _blend(centres, splats, opacities * visible, colors, width, height)
        loss = (image - 0.5).abs().sum() / (cameras * width * height * colors.shape[1])
        (by_pixel,) = torch.autograd.grad(loss, centres)
        gradient = by_pixel.abs().sum(0) if absgrad else by_pixel.sum(0)
        lengths = (gradient * size / 2 * cameras).norm(dim=1)
        radii = extents.ceil().amax(1) / max(width, height)
        state = ReferenceState(lengths * visible, visible.to(lengths), radii * visible).after(state)
    return state


def _project(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int
) -> Splats:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    axes = viewmat[:3, :3] @ torch.stack([torch.stack(row, 1) for row in rows], 1) * scales[:, None]
    places = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depths = places[:, 2]
    focal, principal = torch.stack([K[0, 0], K[1, 1]]), torch.stack([K[0, 2], K[1, 2]])
    size = means.new_tensor([width, height])
    rays, margin = places[:, :2] / depths[:, None], MARGIN * size / 2
    held = rays.maximum(-(principal + margin) / focal).minimum((size - principal + margin) / focal)
    jacobian = means.new_zeros(len(means), 2, 3)
    jacobian[:, 0, 0], jacobian[:, 1, 1] = focal[0] / depths, focal[1] / depths
    jacobian[:, :, 2] = -focal * held / depths[:, None]
    spread = jacobian @ axes
    covariances = spread @ spread.transpose(1, 2) + EPS2D * torch.eye(2, dtype=means.dtype, device=means.device)
    return Splats(rays * focal + principal, covariances, depths)


def _blend(centres: Tensor, splats: Splats, opacities: Tensor, colors: Tensor, width: int, height: int) -> Tensor:
    """Return pixels [P, C] of Gaussians with centres [P, N, 2]."""
    order = splats.depths.argsort()
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 1, 2).to(centres)
    offsets = centres[:, order] - pixels
    inverse = torch.linalg.inv(splats.covariances[order])
    falloff = (-0.5 * torch.einsum("pni,nij,pnj->pn", offsets, inverse, offsets)).exp()
    alphas = (opacities[order] * falloff).clamp_max(ALPHA_MAX)
    alphas = torch.where(alphas > ALPHA_THRESHOLD, alphas, 0.0)
    behind = (1 - alphas).cumprod(1)
    alphas = torch.where(behind > TRANSMITTANCE_MIN, alphas, 0.0)
    before = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], 1)
    return (alphas * before) @ colors[order]
