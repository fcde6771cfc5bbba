"""Cameras as tensors on a device."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..scene import Camera
from ..scene.wide_camera import pixel_directions


@dataclass(frozen=True)
class CameraTensors:
    """A camera on a device; all tensors float32.

    Attributes:
        width: Pixels.
        height: Pixels.
        world_to_camera: [4, 4].
        intrinsics: [4] fx, fy, cx, cy.
        position: [3] in the coordinates that world_to_camera maps; for a training, normalized ones.
        directions: [H, W, 3] unit vectors along which the pixels look, world axes; None for a pinhole.
    """

    width: int
    height: int
    world_to_camera: Tensor
    intrinsics: Tensor
    position: Tensor
    directions: Tensor | None = None

    @staticmethod
    def of(camera: Camera, device: torch.device | str) -> "CameraTensors":
        """Copy a camera to a device."""
        values = camera.world_to_camera, camera.intrinsics, camera.position
        tensors = (torch.tensor(value, dtype=torch.float32, device=device) for value in values)
        directions = None
        if not camera.is_pinhole:
            # Pixels that show nothing do not count; they look along the axis.
            along = np.nan_to_num(pixel_directions(camera)) @ camera.world_to_camera[:3, :3]
            unseen = ~along.any(axis=2, keepdims=True)
            along = np.where(unseen, camera.world_to_camera[2, :3], along)
            directions = torch.tensor(along, dtype=torch.float32, device=device)
        return CameraTensors(camera.width, camera.height, *tensors, directions)  # pyright: ignore[reportCallIssue]
