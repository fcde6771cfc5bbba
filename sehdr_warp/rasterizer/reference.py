"""The splat again in plain torch, with no kernels: the reference that the kernels are held against.

Every formula is written once more, densely, tile by tile, and differentiated by torch. Use float64 for truth.
"""

import math
from itertools import product

import torch

from ..kernels.constants import (
    ALPHA_MAX,
    ALPHA_THRESHOLD,
    EPS2D,
    FRUSTUM_MARGIN,
    LOG_SCALE_MAX,
    NEAR_PLANE,
    TILE_SIZE,
    TRANSMITTANCE_MIN,
)
from .rasterization import Rendering


def project_reference(
    means, log_scales, quaternions, opacities, world_to_camera, intrinsics, width, height, near_plane, eps2d,
    alpha_threshold, antialiased, ray_limit_x=math.inf, ray_limit_y=math.inf,
):
    """Return means2d, conics, depths, opacities and extents (0 if culled) of project_to_camera(), by torch."""
    fx, fy, cx, cy = intrinsics
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    center = means @ rotation.T + translation
    in_front = center[:, 2] > near_plane
    z = torch.where(in_front, center[:, 2], 1.0)
    x_ratio = torch.where(in_front, center[:, 0], 0.0) / z
    y_ratio = torch.where(in_front, center[:, 1], 0.0) / z
    means2d = torch.stack([fx * x_ratio + cx, fy * y_ratio + cy], 1)

    beyond_x, beyond_y = FRUSTUM_MARGIN * width / 2, FRUSTUM_MARGIN * height / 2
    jx = torch.maximum(torch.minimum(x_ratio, (width - cx + beyond_x) / fx), -(cx + beyond_x) / fx)
    jy = torch.maximum(torch.minimum(y_ratio, (height - cy + beyond_y) / fy), -(cy + beyond_y) / fy)
    jx, jy = jx.clamp(-ray_limit_x, ray_limit_x), jy.clamp(-ray_limit_y, ray_limit_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * jx / z], 1), torch.stack([zero, fy / z, -fy * jy / z], 1)], 1
    )
    w, x, y, v = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    local = torch.stack(
        [
            1 - 2 * (y * y + v * v), 2 * (x * y - w * v), 2 * (x * v + w * y),
            2 * (x * y + w * v), 1 - 2 * (x * x + v * v), 2 * (y * v - w * x),
            2 * (x * v - w * y), 2 * (y * v + w * x), 1 - 2 * (x * x + y * y),
        ],
        1,
    ).reshape(-1, 3, 3)
    scales = log_scales.clamp(-LOG_SCALE_MAX, LOG_SCALE_MAX).exp()
    spread = jacobian @ (rotation @ local) * scales[:, None, :]
    covariance = spread @ spread.transpose(1, 2)
    sharp = torch.linalg.cross(spread[:, 0], spread[:, 1]).square().sum(1)
    covariance = covariance + eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    trace = spread.square().sum((1, 2))
    blurred = sharp + eps2d * trace + eps2d * eps2d
    if antialiased:
        opacities = opacities * (sharp / blurred).clamp(min=0.0).sqrt().detach()
    conics = torch.stack([covariance[:, 1, 1], -covariance[:, 0, 1], covariance[:, 0, 0]], 1) / blurred[:, None]
    level = 2 * torch.log((opacities / alpha_threshold).clamp(min=1.0))
    extents = (level[:, None] * torch.stack([covariance[:, 0, 0], covariance[:, 1, 1]], 1)).detach().sqrt()
    usable = in_front & (opacities > alpha_threshold)
    usable &= (means2d[:, 0] + extents[:, 0] > 0) & (means2d[:, 0] - extents[:, 0] < width)
    usable &= (means2d[:, 1] + extents[:, 1] > 0) & (means2d[:, 1] - extents[:, 1] < height)
    return means2d, conics, center[:, 2], opacities, torch.where(usable[:, None], extents, 0.0)


def blend_reference(
    means2d, conics, opacities, features, depths, extents, width, height, alpha_threshold,
    transmittance_min=TRANSMITTANCE_MIN,
):
    """Blend front to back by torch; return image [H, W, C] and the transmittance left [H, W]."""
    order = torch.where(extents[:, 0] > 0, depths, math.inf).argsort(stable=True)
    order = order[: int((extents[:, 0] > 0).sum())]
    low, high = means2d[order] - extents[order], means2d[order] + extents[order]
    pixels = torch.arange(height * width, device=means2d.device).reshape(height, width)
    places, images, final_transmittance = [], [], []
    for corner in product(range(0, width, TILE_SIZE), range(0, height, TILE_SIZE)):
        left, top = means2d.new_tensor(corner)
        here = order[(high[:, 0] > left) & (low[:, 0] < left + TILE_SIZE)
                     & (high[:, 1] > top) & (low[:, 1] < top + TILE_SIZE)]
        places.append(pixels[corner[1] : corner[1] + TILE_SIZE, corner[0] : corner[0] + TILE_SIZE].flatten())
        dx = means2d[here, 0, None] - (places[-1] % width + 0.5)
        dy = means2d[here, 1, None] - (places[-1] // width + 0.5)
        a, b, c = conics[here].T[..., None]
        exponent = (-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy).clamp(max=0.0)
        value = (opacities[here, None] * exponent.exp()).clamp(max=ALPHA_MAX)
        value = torch.where(value > alpha_threshold, value, 0.0)
        # A pixel stops before its transmittance would fall to the limit, so later Gaussians count nothing there.
        value = torch.where(torch.cumprod(1 - value, 0) > transmittance_min, value, 0.0)
        # What each Gaussian finds left, and what all leave.
        transmittance = torch.cumprod(torch.cat([value.new_ones(1, value.shape[1]), 1 - value]), 0)
        images.append(torch.einsum("gp,gc->pc", value * transmittance[:-1], features[here]))
        final_transmittance.append(transmittance[-1])
    place = torch.cat(places).argsort()
    image = torch.cat(images)[place].reshape(height, width, -1)
    return image, torch.cat(final_transmittance)[place].reshape(height, width)


def rasterize_reference(
    means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics, width, height,
    *, near_plane=NEAR_PLANE, eps2d=EPS2D, alpha_threshold=ALPHA_THRESHOLD, antialiased=False,
    ray_limit_x=math.inf, ray_limit_y=math.inf, order_axis=None, transmittance_min=TRANSMITTANCE_MIN,
) -> Rendering:
    """Do what rasterize() does by torch alone, for float64 truth and for comparison.

    transmittance_min: a pixel is finished before its transmittance would fall to this value; 0 never stops.
    """
    means2d, conics, depths, opacities, extents = project_reference(
        means, log_scales, quaternions, opacities, world_to_camera, intrinsics, width, height, near_plane, eps2d,
        alpha_threshold, antialiased, ray_limit_x, ray_limit_y,
    )
    order_depths = depths
    if order_axis is not None:
        center = means @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        order_depths = torch.maximum(center @ (order_axis / order_axis.abs().max()), 0.001 * depths)
    image, transmittance = blend_reference(
        means2d, conics, opacities, features, order_depths, extents, width, height, alpha_threshold, transmittance_min
    )
    return Rendering(image, transmittance, means2d, depths, extents, 0)
