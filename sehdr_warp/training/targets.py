"""Training views: photos, cameras and HDR truth as tensors on the device, and the scale that compares photos."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ..evaluation.metrics import psnr
from ..model.renders import CameraTensors
from ..rasterizer.losses.code_residual import CodeScale, code_tensor, code_values
from ..response import Response
from ..scene import View

CODE = 1 / 255  # One step of an 8-bit photo
MU = 5000.0  # Parameter of the mu-law in which HDR images are compared
KNEE = 8.0  # Code of 255 above black at white / mu in the mu-law of photos, linear below and logarithmic above
GAIN_MAP_KNEE = 0.5  # The same exposure, where codes hold four stops more


@dataclass(frozen=True)
class Target:
    """One training photo on the device."""

    codes: Tensor  # [H, W, 3] as from code_tensor(); or, with an index, a stack [V, H, W, 3] that contains the photo
    scale: CodeScale  # Values and intervals that the codes stand for
    mask: Tensor | None = None  # [H, W, 1] in [0, 1]
    exposure_truth: Tensor | None = None  # [H, W, 3] radiance of HDR truth times the base time
    index: Tensor | None = None  # [1] int64, position of the photo in the stack
    estimates: Tensor | None = None  # Estimates of the light of clipped pixels, as in clipped_light_energy()

    @property
    def encoded(self) -> Tensor:
        """Encoded values [H, W, 3] in [0, 1], computed from the codes at each access."""
        return code_values(select_view(self.codes, self.index))

    def psnr(self, encoded: Tensor) -> float:
        """Return the PSNR of encoded values [H, W, 3] against the photo inside the mask, dB; NaN if it is empty."""
        return psnr(encoded.clamp(0, 1), self.encoded, None if self.mask is None else self.mask[..., 0])


def select_view(stack: Tensor, index: Tensor | None) -> Tensor:
    """Return a copy of element index [1] of a stack [V, ...], on its device; without an index the tensor itself."""
    return stack if index is None else stack.index_select(0, index)[0]


def code_scale(
    largest: int, response: Response | None, device, *, clipping: bool = True, dtype: torch.dtype = torch.float32
) -> CodeScale:
    """Return the scale on which a render is compared with codes: the mu-law of exposures, or encoded values.

    A code stands for a value on this scale: its encoded value, or the middle of the exposures that round to it. With
    `clipping`, the largest code stands for all values from white less half an 8-bit code, and 0 for all up to half a
    code. The half code, for 16 bits too, keeps a response that never quite reaches white from being pulled up.

    The exposures that round to a code near white may span stops. CodeScale.use_intervals() makes all of them equally
    good, less the finest 8-bit step at the ends, so that codes with finer intervals stay values.

    Args:
        largest: Largest code, 255 or 65535.
        response: Response that decodes codes to exposures; None to compare encoded values.
        device: Torch device of the tables.
        clipping: Treat the smallest and the largest code as intervals.
        dtype: Type of the tables.
    """
    mu, white = (0.0, 1.0) if response is None else (mu_of_knee(response), response.white)

    def to_scale(encoded: Tensor) -> Tensor:
        return encoded if response is None else mu_law(response.decode(encoded), white, mu)

    values = torch.arange(largest + 1, dtype=torch.float64) / largest
    centers, between = to_scale(values), to_scale(values[:-1] + 0.5 / largest)
    if response is not None:
        centers[1:-1] = (between[1:] + between[:-1]) / 2
    table, intervals = torch.stack([centers, centers, centers], 1), None
    if clipping:
        table[0, 1], table[-1, 2] = -math.inf, math.inf
        table[0, 2], table[-1, 1] = to_scale(values.new_tensor([CODE / 2, 1 - CODE / 2]))
        if response is not None:
            finest = to_scale((torch.arange(255) + 0.5).double() / 255).diff().min()
            ends = torch.stack([between[:-1] + finest, between[1:] - finest], 1)
            intervals = table.clone()
            intervals[1:-1, 1:] = torch.where(ends[:, :1] < ends[:, 1:], ends, table[1:-1, 1:])
            intervals = intervals.to(device, dtype)
    return CodeScale(table.to(device, dtype), mu, white, intervals)


def mu_of_knee(response: Response) -> float:
    """Return the mu whose knee, white / mu, is the exposure of code KNEE of 255 above black, for any response.

    Log curves have black at a tenth of their codes and more.
    """
    knee = GAIN_MAP_KNEE if response.name == "gain-map" else KNEE
    return response.white / max(float(response.decode(float(response.black) + knee / 255)), 1e-12)


def mu_law(exposure: Tensor, white: float, mu: float = MU) -> Tensor:
    """Return log(1 + mu x / white) / log(1 + mu): 0 for no light, 1 for the exposure that photos show as white."""
    return torch.log1p(exposure * (mu / white)) / math.log1p(mu)


@dataclass(frozen=True)
class TrainingView:
    """A photo to train on."""

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


class PhotoSource(Sequence[TrainingView]):
    """Training views whose photos stay in memory or in a file until they are accessed; each access uploads one.

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
        compare_by: Response | None = None,
        estimates: list[Tensor] | None = None,
    ):
        """Wrap views.

        Args:
            views: The training views.
            base_time: Exposure time dt_1 of the field, seconds.
            device: Torch device.
            truth: Also upload HDR truth.
            clipping: Treat clipped codes as intervals.
            compare_by: Response by which exposures are compared, None to compare encoded values.
            estimates: For each view estimates of the light of clipped pixels, as in Target.
        """
        self.views, self.base_time, self.device = views, base_time, device
        self.truth, self.estimates = truth, estimates
        self._deep = any(view.codes.dtype == np.uint16 for view in views)
        self.scale = code_scale(65535 if self._deep else 255, compare_by, device, clipping=clipping)

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
        tensors = {"codes": code_tensor(self.codes(index), "cpu")}
        if view.mask is not None:
            tensors["mask"] = torch.tensor(np.ascontiguousarray(view.mask), dtype=torch.float32)[..., None]
        if self.truth and view.hdr is not None:
            radiance = torch.tensor(np.ascontiguousarray(view.hdr), dtype=torch.float32)
            tensors["exposure_truth"] = radiance * self.base_time
        if self.estimates is not None:
            tensors["estimates"] = self.estimates[index]
        return tensors

    def codes(self, index: int) -> np.ndarray:
        """Return the codes of a photo, all of one type."""
        codes = self.views[index].codes
        # A factor of 257 maps 8-bit white to 16-bit white and keeps every value.
        return codes.astype(np.uint16) * np.uint16(257) if self._deep and codes.dtype == np.uint8 else codes

    @property
    def bytes(self) -> int:
        """Memory that all views would take on the device."""
        truth = (12 * (self.truth and view.hdr is not None) for view in self.views)
        pixels = (view.camera.width * view.camera.height for view in self.views)
        each = pixel_bytes(self.views)
        return sum(count * (each + more) for count, more in zip(pixels, truth, strict=True))
