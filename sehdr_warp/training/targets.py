"""The training photos on the device, at every resolution of the schedule, uploaded once."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ..model.radiance_field import CameraTensors
from ..model.response import Response
from ..scene import Camera, View
from .losses import CODE, Target


@dataclass(frozen=True)
class TrainingView:
    """A photo to train on: camera, exposure time in seconds, and the target at the camera's size."""

    camera: CameraTensors
    exposure_time: float
    target: Target


def training_views(
    views: tuple[View, ...], level: int, response: Response, base_time: float, device, *, truth: bool
) -> list[TrainingView]:
    """The views at 1 / 2^level of their size. truth: also upload HDR truth. Photos are averaged as exposures, since
    light adds up and encoded values do not; a pixel with a clipped part stays a lower bound."""
    made = []
    for view in views:
        width, height = (max(1, round(size / 2**level)) for size in (view.camera.width, view.camera.height))
        camera: Camera = view.camera.resized(width, height) if level else view.camera
        target = _target(view, (height, width), response, base_time, device, truth)
        made.append(TrainingView(CameraTensors.of(camera, device), view.exposure_time, target))
    return made


def _target(view: View, size: tuple[int, int], response: Response, base_time: float, device, truth: bool) -> Target:
    encoded = _upload(view.image, device)
    clipped, black = encoded >= 1 - CODE / 2, encoded <= CODE / 2
    mask = None if view.mask is None else _upload(view.mask[..., None], device)
    exposure_truth = _upload(view.hdr, device) * base_time if truth and view.hdr is not None else None
    if tuple(encoded.shape[:2]) != size:
        encoded = response.encode(_shrink(response.decode(encoded), size))
        clipped, black = _shrink(clipped.float(), size) > 0, _shrink(black.float(), size) == 1
        mask = None if mask is None else _shrink(mask, size)
        exposure_truth = None if exposure_truth is None else _shrink(exposure_truth, size)
    return Target(
        encoded,
        clipped if bool(clipped.any()) else None,
        black if bool(black.any()) else None,
        mask,
        exposure_truth,
    )


def _upload(array: np.ndarray, device) -> Tensor:
    return torch.tensor(np.ascontiguousarray(array), dtype=torch.float32, device=device)


def _shrink(image: Tensor, size: tuple[int, int]) -> Tensor:
    """[H, W, C] averaged over areas to [*size, C]."""
    return functional.interpolate(image.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0).contiguous()
