"""Training views: cameras and targets on the device, stacked for captured steps or uploaded one by one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ..model.renders import CameraTensors
from ..rasterizer.losses.code_residual import code_tensor
from ..response import Response
from ..scene import View
from .targets import Target, code_scale, select_view


@dataclass(frozen=True)
class TrainingView:
    """A photo to train on: what a step gets."""

    camera: CameraTensors  # Camera on the device
    exposure_time: float | Tensor  # Seconds
    target: Target  # The image to compare with, at the camera's size


@dataclass(frozen=True)
class ViewStack:
    """V training views of one size in shared tensors: [i] is view i; at() selects by an index on the device."""

    width: int  # Pixels
    height: int  # Pixels
    cameras: Tensor  # [V, 24], each view's pose [4, 4], intrinsics [4], position [3] and a 0
    times: Tensor | float  # Exposure times [V] in seconds, or one float if all are equal
    targets: Target  # Target whose images are stacked, [V, ...]

    @staticmethod
    def of(views: Sequence[TrainingView]) -> "ViewStack | None":
        """Stack views; returns None if their sizes differ, one is not a pinhole or only some have HDR truth."""
        kinds = {(view.camera.width, view.camera.height, view.target.exposure_truth is None) for view in views}
        if len(kinds) > 1 or any(view.camera.directions is not None for view in views):
            return None
        cameras, targets, times = zip(*((v.camera, v.target, v.exposure_time) for v in views), strict=True)
        masks, truths = [t.mask for t in targets], [t.exposure_truth for t in targets]
        if any(mask is not None for mask in masks):
            # A view without a mask counts everywhere.
            whole = torch.ones(cameras[0].height, cameras[0].width, 1, device=targets[0].codes.device)
            masks = [whole if mask is None else mask for mask in masks]
        # Rows of a multiple of 16 bytes, because kernels may read four floats at once.
        rows = [torch.cat([c.world_to_camera.flatten(), c.intrinsics, c.position]) for c in cameras]
        stacked = functional.pad(torch.stack(rows), (0, 1))
        time = times[0] if len(set(times)) == 1 else torch.tensor(times, device=stacked.device)
        mask, truth = (None if parts[0] is None else torch.stack(parts) for parts in (masks, truths))
        estimates = None if targets[0].estimates is None else torch.stack([t.estimates for t in targets])
        codes = torch.stack([t.codes for t in targets])
        target = Target(codes, targets[0].scale, mask, truth, estimates=estimates)
        return ViewStack(cameras[0].width, cameras[0].height, stacked, time, target)

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.cameras)

    def __getitem__(self, index: int) -> TrainingView:
        """Return view `index` without copying its photo."""
        time = float(self.times[index]) if isinstance(self.times, Tensor) else self.times
        view = self._view(lambda values: values[index], time)
        return replace(view, target=replace(view.target, codes=self.targets.codes[index]))

    def at(self, index: Tensor) -> TrainingView:
        """Return the view whose number is in index [1], int64, on the views' device.

        The photo stays in the stack, because selecting it here would copy it; kernels select it by the index.
        """
        time = select_view(self.times, index) if isinstance(self.times, Tensor) else self.times
        view = self._view(lambda values: select_view(values, index), time)
        return replace(view, target=replace(view.target, index=index))

    def _view(self, take: Callable[[Tensor], Tensor], time: float | Tensor) -> TrainingView:
        """Return a view without its codes; `take` selects one of a tensor [V, ...]."""
        pose, intrinsics, position = take(self.cameras)[:23].split((16, 4, 3))
        camera = CameraTensors(self.width, self.height, pose.view(4, 4), intrinsics, position)
        names = "mask", "exposure_truth", "estimates"
        parts = {name: None if (v := getattr(self.targets, name)) is None else take(v) for name in names}
        return TrainingView(camera, time, replace(self.targets, **parts))


def pixel_bytes(views: Sequence[View]) -> int:
    """Return the bytes of a pixel's codes and mask on the device: if one photo has 16 bits or a mask, all get them."""
    codes = 6 if any(view.codes.dtype == np.uint16 for view in views) else 3
    return codes + 4 * any(view.mask is not None for view in views)


class ViewDataset(Sequence[TrainingView]):
    """Training views whose photos stay in memory or in a file; [i] uploads view i at each access.

    Attributes:
        scale: Values and intervals that the codes stand for.
    """

    def __init__(
        self,
        views: Sequence[View],
        base_time: float,
        device,
        *,
        truth: bool,
        clipping: bool = True,
        response: Response | None = None,
        estimates: list[Tensor] | None = None,
    ):
        """Wrap views.

        Args:
            views: The training views.
            base_time: Exposure time dt_1 of the field, seconds.
            device: Torch device.
            truth: Also upload HDR truth.
            clipping: As in code_scale().
            response: As in code_scale(): exposures are compared by it, encoded values without.
            estimates: For each view those of its Target.
        """
        self.views, self.base_time, self.device = views, base_time, device
        self.truth, self.estimates = truth, estimates
        self._deep = any(view.codes.dtype == np.uint16 for view in views)
        self.scale = code_scale(65535 if self._deep else 255, response, device, clipping=clipping)

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.views)

    def __getitem__(self, index: int) -> TrainingView:
        """Upload a view to the device."""
        view, tensors = self.views[index], {name: t.to(self.device) for name, t in self.tensors(index).items()}
        camera = CameraTensors.of(view.camera, self.device)
        return TrainingView(camera, view.exposure_time, Target(scale=self.scale, **tensors))

    def tensors(self, index: int) -> dict[str, Tensor]:
        """Return the tensors of a photo's Target on the CPU, by their names there; those that the photo has."""
        view = self.views[index]
        codes = view.codes
        if self._deep and codes.dtype == np.uint8:
            codes = codes.astype(np.uint16) * np.uint16(257)  # Maps 8-bit white to 16-bit white and keeps every value.
        tensors = {"codes": code_tensor(codes, "cpu")}
        if view.mask is not None:
            tensors["mask"] = torch.tensor(np.ascontiguousarray(view.mask), dtype=torch.float32)[..., None]
        if self.truth and view.hdr is not None:
            radiance = torch.tensor(np.ascontiguousarray(view.hdr), dtype=torch.float32)
            tensors["exposure_truth"] = radiance * self.base_time
        if self.estimates is not None:
            tensors["estimates"] = self.estimates[index]
        return tensors

    @property
    def bytes(self) -> int:
        """Memory that all views would take on the device."""
        each, truth = pixel_bytes(self.views), 12 * self.truth
        return sum(v.camera.pixel_count * (each + truth * (v.hdr is not None)) for v in self.views)
