"""Cameras on a device, and what rendering a radiance field returns: a training view, a view, light along directions."""

import math
from dataclasses import dataclass
from numbers import Real

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..rasterizer import Rendering
from ..scene import Camera
from ..scene.wide_camera import pixel_directions


@dataclass(frozen=True)
class PhotoRender:
    """A differentiable render of a training view; images [H, W, 3], None if they were not requested.

    Attributes:
        encoded: Encoded values, extended beyond [0, 1] as by Response.encode_extended.
        exposure: Exposure of the HDR color at the base time (I^h dt_1 in the paper); None for display colors.
        base: Exposure of the base color at the base time (I^b); the same tensor as `exposure` without fusion.
        rendering: Result of the rasterizer: transmittance, projected means, extents.
        photo_exposure: Exposure of this photo, the input of the response; None if colors are encoded before they are
            composited.
        opacities: [N] opacities of the Gaussians.
    """

    encoded: Tensor | None
    exposure: Tensor | None
    base: Tensor | None
    rendering: Rendering
    photo_exposure: Tensor | None = None
    opacities: Tensor | None = None


@dataclass(frozen=True)
class RenderedView:
    """A rendered view of a trained scene, composited over black.

    Attributes:
        hdr: [H, W, 3] float32 scene-linear radiance, >= 0, not multiplied by an exposure time.
        alpha: [H, W] coverage in [0, 1].
        depth: [H, W] mean distance if alpha is above 0.001, else 0; scene units; along the axis of a pinhole camera,
            from the place of a panorama or fisheye camera.
        confidence: [H, W] in [0, 1] as in DirectionalRender; None if it was not measured or not asked for.
        clipped: [H, W] in [0, 1], as from render_clipped; None if it was not measured or not asked for.
    """

    hdr: Tensor
    alpha: Tensor
    depth: Tensor
    confidence: Tensor | None = None
    clipped: Tensor | None = None

    def reduced(self, factor: int) -> "RenderedView":
        """Return the view at a size that is smaller by an integer factor: the mean of each factor x factor pixels."""
        if factor == 1:
            return self
        covered = torch.stack([self.alpha, self.alpha * self.depth])
        images = avg_pool2d(torch.cat([self.hdr.permute(2, 0, 1), covered]), factor)
        alpha = images[3]
        depth = (images[4] / alpha.clamp_min(1e-3)).masked_fill(alpha <= 1e-3, 0)
        return RenderedView(images[:3].permute(1, 2, 0).contiguous(), alpha, depth)


@dataclass(frozen=True)
class DirectionalRender:
    """A rendered environment: a trained scene along directions from one point, composited over black.

    Attributes:
        hdr: [H, W, 3] as in RenderedView.
        alpha: [H, W] as in RenderedView.
        distance: [H, W] mean distance if alpha is above 0.001, else 0; scene units.
        confidence: [H, W] in [0, 1], as from render_confidence; None if it was not measured.
        clipped: [H, W] in [0, 1], the mean of the shares that render_directions() was called with, weighted by light;
            None without shares.
    """

    hdr: Tensor
    alpha: Tensor
    distance: Tensor
    confidence: Tensor | None
    clipped: Tensor | None = None


@dataclass(frozen=True)
class CameraTensors:
    """A camera on a device; all tensors float32."""

    width: int  # Pixels
    height: int  # Pixels
    world_to_camera: Tensor  # [4, 4]
    intrinsics: Tensor  # [4] fx, fy, cx, cy
    position: Tensor  # [3] in the coordinates that world_to_camera maps; for a training, normalized ones
    directions: Tensor | None = None  # [H, W, 3] unit vectors along which pixels look, world axes; None to linearize
    lens_mask: Tensor | None = None  # [H, W] 1 within the picture of the lens, 0 beyond; None if all is within

    @staticmethod
    def of(camera: Camera, device: torch.device | str, *, along_rays: bool = False) -> "CameraTensors":
        """Copy a camera to a device, a pinhole with the directions of its pixels if `along_rays`."""
        values = camera.world_to_camera, camera.intrinsics, camera.position
        pose, *others = (torch.tensor(value, dtype=torch.float32, device=device) for value in values)
        directions = lens_mask = None
        if not camera.is_pinhole:
            along = pixel_directions(camera) @ camera.world_to_camera[:3, :3]
            inside = np.isfinite(along[..., 0])
            # Pixels without a ray look along the axis; lens_mask makes them black.
            along = np.where(inside[..., None], along, camera.world_to_camera[2, :3])
            directions = torch.tensor(along, dtype=torch.float32, device=device)
            lens_mask = None if inside.all() else torch.tensor(inside, dtype=torch.float32, device=device)
        elif along_rays:
            directions = _rays(camera, pose)
        width, height = camera.width, camera.height
        return CameraTensors(width, height, pose, *others, directions, lens_mask)  # pyright: ignore[reportCallIssue]


def _rays(camera: Camera, pose: Tensor) -> Tensor:
    """Return pixel_directions() of a pinhole in world axes, computed on the device of its pose for every picture."""
    columns, rows = (torch.arange(size, device=pose.device) + 0.5 for size in (camera.width, camera.height))
    x, y = torch.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, indexing="xy")
    along = x[..., None] * pose[0, :3] + y[..., None] * pose[1, :3] + pose[2, :3]
    return along / along.norm(dim=2, keepdim=True)


def require_time(time: object) -> None:
    """Raise ValueError for an exposure time that is not a positive number."""
    if not isinstance(time, Real) or not 0 < float(time) < math.inf:
        raise ValueError(f"exposure_time is {time!r}, expected seconds, such as 1 / 125")


def unpremultiply(blended: Tensor, alpha: Tensor) -> Tensor:
    """Return blended / alpha if alpha is above 0.001, else 0; [H, W] each, or [H, W, C] and [H, W, 1]."""
    return (blended / alpha.clamp_min(1e-3)).masked_fill_(~(alpha > 1e-3), 0)
