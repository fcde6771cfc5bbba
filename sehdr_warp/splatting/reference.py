"""The splat again in plain torch, with no kernels: the reference that the kernels are held against.

Every formula is written once more, densely, tile by tile, and differentiated by torch. Use float64 for truth.
"""

import math

import torch

from ..kernels.constants import (
    ALPHA_MAX,
    ALPHA_THRESHOLD,
    FRUSTUM_MARGIN,
    LOG_SCALE_MAX,
    LOW_PASS,
    NEAR,
    TILE_SIZE,
    TRANSMITTANCE_MIN,
)
from .rasterization import Rendering


def project_reference(
    means, log_scales, quaternions, opacities, world_to_camera, intrinsics, width, height, near, low_pass,
    alpha_threshold, antialiased,
):
    """projection.project in torch: means2d, conics, depths, opacities and extents (0 where culled)."""
    fx, fy, cx, cy = intrinsics
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    centre = means @ rotation.T + translation
    in_front = centre[:, 2] > near
    z = torch.where(in_front, centre[:, 2], 1.0)
    x_ratio = torch.where(in_front, centre[:, 0], 0.0) / z
    y_ratio = torch.where(in_front, centre[:, 1], 0.0) / z
    means2d = torch.stack([fx * x_ratio + cx, fy * y_ratio + cy], 1)

    beyond_x, beyond_y = FRUSTUM_MARGIN * width / 2, FRUSTUM_MARGIN * height / 2
    jx = torch.maximum(torch.minimum(x_ratio, (width - cx + beyond_x) / fx), -(cx + beyond_x) / fx)
    jy = torch.maximum(torch.minimum(y_ratio, (height - cy + beyond_y) / fy), -(cy + beyond_y) / fy)
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
    covariance = covariance + low_pass * torch.eye(2, dtype=means.dtype, device=means.device)
    trace = spread.square().sum((1, 2))
    blurred = sharp + low_pass * trace + low_pass * low_pass
    if antialiased:
        opacities = opacities * (sharp / blurred).clamp(min=0.0).sqrt().detach()
    conics = torch.stack([covariance[:, 1, 1], -covariance[:, 0, 1], covariance[:, 0, 0]], 1) / blurred[:, None]
    level = 2 * torch.log((opacities / alpha_threshold).clamp(min=1.0))
    extents = (level[:, None] * torch.stack([covariance[:, 0, 0], covariance[:, 1, 1]], 1)).detach().sqrt()
    usable = in_front & (opacities > alpha_threshold)
    usable &= (means2d[:, 0] + extents[:, 0] > 0) & (means2d[:, 0] - extents[:, 0] < width)
    usable &= (means2d[:, 1] + extents[:, 1] > 0) & (means2d[:, 1] - extents[:, 1] < height)
    return means2d, conics, centre[:, 2], opacities, torch.where(usable[:, None], extents, 0.0)


def blend_reference(
    means2d, conics, opacities, features, depths, extents, width, height, alpha_threshold,
    transmittance_min=TRANSMITTANCE_MIN,
):
    """Front-to-back blending in torch: image [H, W, C] and the transmittance left [H, W]."""
    device, dtype = means2d.device, means2d.dtype
    image_rows, left_over_rows = [], []
    order = torch.where(extents[:, 0] > 0, depths, math.inf).argsort(stable=True)
    order = order[: int((extents[:, 0] > 0).sum())]
    for top in range(0, height, TILE_SIZE):
        image_tiles, left_over_tiles = [], []
        for left in range(0, width, TILE_SIZE):
            right, bottom = min(left + TILE_SIZE, width), min(top + TILE_SIZE, height)
            near_x = (means2d[order, 0] + extents[order, 0] > left) & (means2d[order, 0] - extents[order, 0] < right)
            near_y = (means2d[order, 1] + extents[order, 1] > top) & (means2d[order, 1] - extents[order, 1] < bottom)
            here = order[near_x & near_y]
            y, x = torch.meshgrid(
                torch.arange(top, bottom, device=device, dtype=dtype) + 0.5,
                torch.arange(left, right, device=device, dtype=dtype) + 0.5,
                indexing="ij",
            )
            dx = means2d[here, 0, None] - x.reshape(1, -1)
            dy = means2d[here, 1, None] - y.reshape(1, -1)
            a, b, c = (conics[here, k, None] for k in range(3))
            exponent = (-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy).clamp(max=0.0)
            value = (opacities[here, None] * exponent.exp()).clamp(max=ALPHA_MAX)
            value = torch.where(value > alpha_threshold, value, 0.0)
            # A pixel stops before its transmittance would fall to the limit, so later Gaussians count nothing there.
            running = torch.cumprod(1 - value, 0)
            value = torch.where(running > transmittance_min, value, 0.0)
            after = torch.cumprod(1 - value, 0)
            before = torch.cat([torch.ones_like(after[:1]), after[:-1]]) if len(here) else after
            tile = torch.einsum("gp,gc->pc", value * before, features[here])
            left_over = after[-1] if len(here) else torch.ones_like(x.reshape(-1))
            image_tiles.append(tile.reshape(bottom - top, right - left, -1))
            left_over_tiles.append(left_over.reshape(bottom - top, right - left))
        image_rows.append(torch.cat(image_tiles, 1))
        left_over_rows.append(torch.cat(left_over_tiles, 1))
    return torch.cat(image_rows, 0), torch.cat(left_over_rows, 0)


def rasterize_reference(
    means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics, width, height,
    *, near=NEAR, low_pass=LOW_PASS, alpha_threshold=ALPHA_THRESHOLD, antialiased=False,
    transmittance_min=TRANSMITTANCE_MIN,
) -> Rendering:
    """rasterize() in plain torch, for float64 truth and for comparison; same arguments, same result.

    transmittance_min: a pixel is finished before its transmittance would fall to this value; 0 never stops.
    """
    means2d, conics, depths, opacities, extents = project_reference(
        means, log_scales, quaternions, opacities, world_to_camera, intrinsics, width, height, near, low_pass,
        alpha_threshold, antialiased,
    )
    image, transmittance = blend_reference(
        means2d, conics, opacities, features, depths, extents, width, height, alpha_threshold, transmittance_min
    )
    return Rendering(image, transmittance, means2d, depths, extents.amax(1), 0)
