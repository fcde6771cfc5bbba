"""The training views as steps take them: in which order, and from where on the device.

On a CPU, DataManager.views is a ViewDataset, whose photos stay in memory or in a mapped file. On a GPU it is a
ViewStack, or a PhotoStream if the device has no memory for all photos: steps then read theirs from one of a few slots.
A thread copies the next photo to pinned memory and from there to the device, on a stream of its own, while the step
before it runs. Without CUDA graphs, a GPU takes views from a list or a ViewDataset.
"""

import logging
import operator
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from ..limits import format_bytes
from ..model.radiance_field import RadianceField
from ..model.renders import CameraTensors
from ..rasterizer.warp_launch.threads import one_torch_thread
from ..runs.config import Config
from ..runs.light_estimates import ClippedLight, light_estimates
from ..scene import View
from .losses import comparing_response
from .targets import Target, select_view
from .training_views import TrainingView, ViewDataset, ViewStack

log = logging.getLogger(__name__)

INTERVALS_FROM = 0.85
"""Fraction of a training after which bright codes are intervals. From the start, clipped light would have fewer pixels
around it that determine it."""
SLOTS = 3  # One is read, one is filled, and one may still be read by a step that has not finished
MAX_MEMORY_PART = 0.4  # Of the device's free memory for photos; stacking them takes as much again for a while


class DataManager:
    """Makes the training views what steps take, and uploads them at the first access of `views`."""

    def __init__(self, views: Sequence[View], field: RadianceField, config: Config, *, use_cuda_graph: bool):
        """Prepare the views of a field's normalized scene; steps are captured if use_cuda_graph."""
        self._scene_views, self._field, self._config, self._use_cuda_graph = views, field, config, use_cuda_graph
        self._uses_intervals = False
        self.has_measured = False  # Whether estimates were replaced, so that a checkpoint has to hold them

    @cached_property
    def light_estimates(self) -> list[ClippedLight] | None:
        """Estimates of each view's clipped light; None if there are none, or if colors are encoded values."""
        field = self._field
        response = None if field.color_model.display_referred else field.response
        with one_torch_thread():  # As in the steps, because the prior's sums depend on the number of threads.
            return light_estimates(self._scene_views, response, self._config.loss, field.gaussians.means.device)

    @property
    def clipped_light_targets(self) -> list[Tensor] | None:
        """Estimates [h, w, 6] of each view's log light, to which the loss pulls clipped pixels; None if it does not."""
        if comparing_response(self._config.loss, self._field) is None or self.light_estimates is None:
            return None
        return [estimate.log_light for estimate in self.light_estimates]

    def update_targets(self, iteration: int) -> None:
        """Treat bright codes as intervals if the iteration is late in the training, see INTERVALS_FROM."""
        if iteration > INTERVALS_FROM * self._config.schedule.iterations and not self._uses_intervals:
            self._uses_intervals = True
            self._dataset.scale.use_intervals()

    def replace_estimates(self, estimates: Sequence[Tensor]) -> None:
        """Replace the estimates [h, w, 6] of all views, also in those that are on the device already."""
        views, self.has_measured = self.views, True
        for index, estimate in enumerate(estimates):
            assert self._dataset.estimates is not None
            self._dataset.estimates[index] = estimate.cpu()
            if isinstance(views, ViewStack):
                assert views.targets.estimates is not None
                views.targets.estimates[index].copy_(estimate)
            elif isinstance(views, list):
                on_device = estimate.to(self._dataset.device)
                views[index] = replace(views[index], target=replace(views[index].target, estimates=on_device))
        if isinstance(views, PhotoStream):
            views.forget()

    @property
    def estimates(self) -> list[Tensor] | None:
        """Estimates [h, w, 6] of each view's log light as the steps take them; None if they take none."""
        return self._dataset.estimates

    @cached_property
    def views(self) -> "DeviceViews":
        """The views that a step selects one from, see the module."""
        dataset, where, device = self._dataset, self._config.schedule.photo_cache, torch.device(self._dataset.device)
        if device.type == "cpu":  # Memory is the device's, or a file is mapped into it.
            return dataset
        limit = MAX_MEMORY_PART * torch.cuda.mem_get_info(device)[0]
        if where in ("memory", "disk") or (where == "auto" and dataset.bytes > limit):
            log.info("plan: photos: %s are copied to %s one by one, a step ahead", format_bytes(dataset.bytes), device)
            try:
                return PhotoStream(dataset) if self._use_cuda_graph else dataset
            except ValueError as error:
                log.info("%s: they are copied one by one, and steps are not captured as CUDA graphs", error)
                return dataset
        views = list(dataset)
        # Only captured steps need all photos in one tensor.
        return (ViewStack.of(views) if self._use_cuda_graph else None) or views

    @cached_property
    def _dataset(self) -> ViewDataset:
        """The views, with the scale of their codes."""
        loss, field = self._config.loss, self._field
        return ViewDataset(
            self._scene_views,
            field.base_time,
            field.gaussians.means.device,
            clipping=loss.clipping,
            response=comparing_response(loss, field),
            estimates=self.clipped_light_targets,
            truth=loss.uses_hdr,
        )


class PhotoSampler:
    """The order of `count` photos; all ranks draw the same order, and each takes its own photo of a step."""

    def __init__(self, count: int, seed: int, rank: int = 0, ranks: int = 1):
        """Create an order of `count` photos for process `rank` of `ranks`."""
        self._count, self._rank, self._ranks = count, rank, ranks
        self._remaining: list[int] = []
        self._generator = torch.Generator().manual_seed(seed)

    def next(self) -> int:
        """Return the index of this rank's next photo."""
        batch = []
        for _ in range(self._ranks):
            if not self._remaining:
                self._remaining = torch.randperm(self._count, generator=self._generator).tolist()
            batch.append(self._remaining.pop())
        return batch[self._rank]

    def peek(self) -> int | None:
        """Return what next() will return, or None if a new order has to be drawn first."""
        return self._remaining[-1 - self._rank] if self._rank < len(self._remaining) else None

    def state(self) -> tuple[Tensor, list[int]]:
        """Return the generator's state and the photos that remain of this order."""
        return self._generator.get_state(), list(self._remaining)

    def load_state(self, generator: Tensor, remaining: list) -> None:
        """Continue from state(); raises ValueError if it names photos that do not exist."""
        self._generator.set_state(generator.cpu())
        self._remaining = [operator.index(photo) for photo in remaining]
        if not all(0 <= photo < self._count for photo in self._remaining):
            raise ValueError(f"the order of the photos names others than the {self._count} there are")


class PhotoStream:
    """A replacement of ViewStack with SLOTS photos on the device.

    Call stage() for a view before at() returns it, and release() once the kernels that read it are launched. [i] is a
    copy of view i, with the same values as in ViewStack: steps that are not captured read it.
    """

    def __init__(self, dataset: ViewDataset):
        """Allocate the slots; raises ValueError if views differ in size, or only some have HDR truth."""
        views, self._dataset, self._device = dataset.views, dataset, torch.device(dataset.device)
        sizes = {(v.camera.width, v.camera.height, dataset.truth and v.hdr is not None) for v in views}
        if len(sizes) > 1 or not all(view.camera.is_pinhole for view in views):
            raise ValueError(
                "photos differ in size, only some have HDR truth, or some are panoramas: no stack holds them"
            )
        self._cuda = self._device.type == "cuda"
        examples = dataset.tensors(0)
        if any(view.mask is not None for view in views):  # A view without a mask counts everywhere.
            examples.setdefault("mask", torch.ones(*views[0].codes.shape[:2], 1))
        self._slots = {name: t.new_zeros((SLOTS, *t.shape), device=self._device) for name, t in examples.items()}
        pinned = self._slots if self._cuda else {}
        self._pinned = {name: torch.zeros_like(t, device="cpu", pin_memory=True) for name, t in pinned.items()}
        # Cameras of all views, without photos.
        blank = Target(self._slots["codes"][0, :0, :0], dataset.scale)
        cameras = [TrainingView(CameraTensors.of(v.camera, self._device), v.exposure_time, blank) for v in views]
        stack = ViewStack.of(cameras)
        assert stack is not None
        self._cameras = stack
        self._slot_index = torch.zeros(1, dtype=torch.int64, device=self._device)
        self._slot_views: list[int | None] = [None] * SLOTS
        self._filling: list[Future | None] = [None] * SLOTS
        self._current = 0
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="sehdr-warp photos")
        if self._cuda:
            self._stream = torch.cuda.Stream(self._device)
            self._filled, self._free = ([torch.cuda.Event() for _ in range(SLOTS)] for _ in range(2))
            for event in self._free:  # The slots are free once they are zeroed, on this stream.
                event.record(torch.cuda.current_stream(self._device))

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self._dataset)

    def __getitem__(self, index: int) -> TrainingView:
        """Return a copy of a view on the device."""
        view, tensors = self._cameras[index], self._dataset.tensors(index)
        tensors = {name: tensor.to(self._device) for name, tensor in tensors.items()}
        if "mask" in self._slots:  # Without a mask, the loss has other kernels, whose sums have other last bits.
            tensors.setdefault("mask", torch.ones_like(self._slots["mask"][0]))
        return replace(view, target=Target(scale=self._dataset.scale, **tensors))

    @property
    def times(self) -> Tensor | float:
        """Exposure times, as in ViewStack."""
        return self._cameras.times

    def at(self, index: Tensor) -> TrainingView:
        """Return the view whose number is in index [1], as in ViewStack; stage() must have been called for it."""
        view = self._cameras.at(index)
        parts = {name: select_view(slots, self._slot_index) for name, slots in self._slots.items() if name != "codes"}
        return replace(view, target=replace(view.target, codes=self._slots["codes"], index=self._slot_index, **parts))

    def stage(self, index: int) -> None:
        """Make a view available to the kernels that are launched next."""
        self._fetch(index)
        self._current = slot = self._slot_views.index(index)
        filling = self._filling[slot]
        assert filling is not None
        filling.result()
        if self._cuda:
            torch.cuda.current_stream(self._device).wait_event(self._filled[slot])
        self._slot_index.fill_(slot)

    def release(self, next_index: int | None) -> None:
        """Mark the view of stage() as read by launched kernels, and start to fetch the next one."""
        if self._cuda:
            self._free[self._current].record(torch.cuda.current_stream(self._device))
        if next_index is not None:
            self._fetch(next_index)

    def forget(self) -> None:
        """Read the next views again, because their estimates were replaced."""
        self._slot_views = [None] * SLOTS

    def _fetch(self, index: int) -> None:
        """Start to fill a slot with a view unless one holds it."""
        if index not in self._slot_views:
            slot = (self._current + 1) % SLOTS
            self._slot_views[slot] = index
            self._filling[slot] = self._thread.submit(self._fill, slot, index)

    def _fill(self, slot: int, index: int) -> None:
        """Copy a view to its slot; runs on the thread."""
        if self._cuda:
            self._filled[slot].synchronize()  # The previous copy from pinned memory is done.
        tensors = {"mask": torch.ones(())} | self._dataset.tensors(index)
        for name, slots in (self._pinned or self._slots).items():
            slots[slot].copy_(tensors[name])
        if self._cuda:
            with torch.cuda.stream(self._stream):
                self._stream.wait_event(self._free[slot])
                for name, slots in self._slots.items():
                    slots[slot].copy_(self._pinned[name][slot], non_blocking=True)
                self._filled[slot].record(self._stream)


DeviceViews = ViewStack | PhotoStream | Sequence[TrainingView]
"""Type of DataManager.views: len() of it is the number of views, [i] is view i."""
