"""Photos that come to the device as steps need them, where it has no room for all.

A recorded step reads its photo at a place in a ring of a few. A thread copies the next one, from memory or a mapped
file, to pinned memory and from there on a stream of its own, while the step before it is at work.
"""

import logging
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..model.radiance_field import CameraTensors
from .losses import Target, one_of
from .targets import PhotoSource, TrainingView, ViewStack

log = logging.getLogger(__name__)

SLOTS = 3  # One is read, one is being filled, and one may still be read by a step that is not done
SHARE = 0.4
"""Of the device's free memory, photos stay on it up to so much: to stack them takes as much again for a while."""


def fits_device(source: PhotoSource, device: torch.device) -> bool:
    """Whether all photos may stay on a GPU."""
    return source.bytes <= SHARE * torch.cuda.mem_get_info(device)[0]


def held_views(source: PhotoSource, where: str, recorded: bool) -> "ViewStack | PhotoStream | Sequence[TrainingView]":
    """The views of a source as steps take them. where: schedule.photo_cache. recorded: whether steps are."""
    device = torch.device(source.device)
    if device.type == "cpu":  # Memory is the device's, or a file is mapped into it.
        return source
    if where in ("memory", "disk") or (where == "auto" and not fits_device(source, device)):
        log.info("plan: photos: %.3g GB go to %s one by one, a step ahead", source.bytes / 1e9, device)
        return _streamed(source) if recorded else source
    views = list(source)
    # Only recorded steps need what they read in one place.
    return (ViewStack.of(views) if recorded else None) or views


def _streamed(source: PhotoSource) -> "PhotoStream | PhotoSource":
    try:
        return PhotoStream(source)
    except ValueError as error:
        log.info("%s: they are copied one by one, and steps are not recorded", error)
        return source


class PhotoStream:
    """What ViewStack is, with SLOTS photos on the device. bring() a view before at() is asked for it, and say used()
    once what reads it is launched; [i] is view i, made anew.

    Views are of one size; raises ValueError otherwise, and where only some have HDR truth.
    """

    def __init__(self, source: PhotoSource):
        views, self._source = source.views, source
        first = source[0]
        kinds = {(v.camera.width, v.camera.height, source.truth and v.hdr is not None) for v in views}
        if len(kinds) > 1:
            raise ValueError("photos of several sizes, or only some with truth, have no common place")
        self._device = first.target.codes.device
        self._cuda = self._device.type == "cuda"
        masked = any(view.mask is not None for view in views)
        shapes = {"codes": first.target.codes, "exposure_truth": first.target.exposure_truth}
        shapes["estimates"] = first.target.estimates
        shapes["mask"] = torch.empty(first.camera.height, first.camera.width, 1) if masked else None
        self._parts = {name: like for name, like in shapes.items() if like is not None}
        self._slots = {name: self._room(like, SLOTS, self._device) for name, like in self._parts.items()}
        self._pinned = (
            {name: self._room(like, SLOTS, "cpu") for name, like in self._parts.items()} if self._cuda else {}
        )
        # Cameras of all; photos of none.
        blank = Target(first.target.codes[:0, :0], first.target.scale)
        cameras = [TrainingView(CameraTensors.of(v.camera, self._device), v.exposure_time, blank) for v in views]
        stack = ViewStack.of(cameras)
        assert stack is not None
        self._cameras = stack
        self._place = torch.zeros(1, dtype=torch.int64, device=self._device)
        self._held: list[int | None] = [None] * SLOTS
        self._filling: list[Future | None] = [None] * SLOTS
        self._now = 0
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="sehdr-warp photos")
        if self._cuda:
            self._stream = torch.cuda.Stream(self._device)
            self._filled, self._free = ([torch.cuda.Event() for _ in range(SLOTS)] for _ in range(2))

    def _room(self, like: Tensor, count: int, device: Any) -> Tensor:
        pinned = self._cuda and torch.device(device).type == "cpu"
        return torch.zeros((count, *like.shape), dtype=like.dtype, device=device, pin_memory=pinned)

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: int) -> TrainingView:
        return self._source[index]

    @property
    def times(self) -> Tensor | float:
        return self._cameras.times

    def at(self, index: Tensor) -> TrainingView:
        """The view whose number is in index [1], which was brought; as of ViewStack."""
        view = self._cameras.at(index)
        parts = {name: one_of(slots, self._place) for name, slots in self._slots.items() if name != "codes"}
        return replace(view, target=replace(view.target, codes=self._slots["codes"], index=self._place, **parts))

    def bring(self, index: int) -> None:
        """Has a view in its place on the device for what is launched next."""
        self._fetch(index)
        self._now = slot = self._held.index(index)
        filling = self._filling[slot]
        assert filling is not None
        filling.result()
        if self._cuda:
            torch.cuda.current_stream(self._device).wait_event(self._filled[slot])
        self._place.fill_(slot)

    def used(self, following: int | None) -> None:
        """What reads the view that was brought is launched; the one that will follow is fetched meanwhile."""
        if self._cuda:
            self._free[self._now].record(torch.cuda.current_stream(self._device))
        if following is not None:
            self._fetch(following)

    def _fetch(self, index: int) -> None:
        if index not in self._held:
            slot = (self._now + 1) % SLOTS
            self._held[slot] = index
            self._filling[slot] = self._thread.submit(self._fill, slot, index)

    def _fill(self, slot: int, index: int) -> None:
        for name, array in self._arrays(index).items():
            if not self._cuda:
                self._slots[name][slot].copy_(array)
                continue
            self._filled[slot].synchronize()  # What was there before has left the pinned memory.
            self._pinned[name][slot].copy_(array)
        if self._cuda:
            with torch.cuda.stream(self._stream):
                self._stream.wait_event(self._free[slot])
                for name, slots in self._slots.items():
                    slots[slot].copy_(self._pinned[name][slot], non_blocking=True)
                self._filled[slot].record(self._stream)

    def _arrays(self, index: int) -> dict[str, Tensor]:
        """A photo's codes, truth as exposure and mask, on the CPU."""
        view, codes = self._source.views[index], self._source.codes(index)
        found = {"codes": torch.from_numpy(codes.view(np.int16) if codes.dtype == np.uint16 else codes)}
        if "exposure_truth" in self._parts:
            assert view.hdr is not None
            found["exposure_truth"] = torch.from_numpy(np.asarray(view.hdr, np.float32)) * self._source.base_time
        if self._source.estimates is not None:
            found["estimates"] = self._source.estimates[index]
        if "mask" in self._parts:  # One without a mask counts everywhere.
            whole = np.ones(view.codes.shape[:2], np.float32) if view.mask is None else view.mask
            found["mask"] = torch.from_numpy(np.asarray(whole, np.float32))[..., None]
        return found
