"""Drawings that are asked for again and again, replayed: at what the GPU needs instead of what Python needs.

Drawing projected Gaussians is some ten launches, and called one by one from Python they take longer than a small
picture does. After a few calls with the same sizes what follows is recorded as CUDA graphs, on memory of its own:
arguments are copied in, what a call returns is copied out.
"""

import atexit
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from .blending import Adjoint, BlendResult, blend_on_cuda
from .cuda_graphs import CudaGraphRunner, is_capturing
from .tile_lists import MAX_INTERSECTIONS, ONE_SORT, build_tile_lists, order_intersections, pack_gaussians
from .warp_launch.launching import stream_handle

LOG = logging.getLogger(__name__)

WARMUP_CALLS = 4  # Calls of a kind before it is recorded: a recording costs as much as some twenty of them
KINDS = 3  # Kinds of calls that are remembered, the latest
TOGETHER = 4  # Calls of a kind whose backward passes are still to come: each has a recording of its own
LARGEST_IMAGE = 1 << 21  # In pixels; larger ones wait for the GPU as it is
LARGEST_COUNT = 1 << 21  # Of Gaussians, without a backward pass; with one the host is behind only up to ONE_SORT
ROOM = 1.25  # For this many times the (Gaussian, tile) pairs of the call that is recorded
LEAST_ROOM = 1 << 12


class Given(NamedTuple):
    """Projected Gaussians as they are drawn, float32 and contiguous: means2d [N, 2], conics [N, 3], opacities [N],
    features [N, C], depths [N], extents [N, 2]."""

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    features: Tensor
    depths: Tensor
    extents: Tensor


class Frame(NamedTuple):
    """Size of the picture in pixels, and the alpha under which a Gaussian is left out."""

    width: int
    height: int
    alpha_threshold: float


@torch.no_grad()
def replayed(given: Given, frame: Frame, differentiable: bool) -> tuple[BlendResult, int] | None:
    """The picture and the number of its (Gaussian, tile) pairs; None where the call is to be launched instead.

    given: its extents become 0 where a feature is not finite.
    differentiable: whether the picture's adjoint may be asked for.
    """
    features, device = given.features, given.features.device
    small = 0 < len(features) <= (ONE_SORT if differentiable else LARGEST_COUNT)
    small &= frame.width * frame.height <= LARGEST_IMAGE
    if device.type != "cuda" or features.dtype != torch.float32 or not small or is_capturing(device):
        return None
    kind = _kind((device, stream_handle(device), *features.shape, frame, differentiable))
    recording = kind.take(lambda pairs: _Recording(given, frame, pairs))
    if recording is None:
        return None
    image, transmittance, pairs = recording.play(given)
    if pairs > recording.room:
        kind.grow(pairs)
        return None
    if not differentiable:
        kind.idle.append(recording)
        return BlendResult(image, transmittance, recording.adjoint), pairs
    lease = _Lease(kind.idle, recording)
    return BlendResult(image, transmittance, lease.adjoint), pairs


class _Recording:
    """One drawing on fixed memory, in two parts, between which the host learns how many pairs there are.

    pairs: room is made for so many at least."""

    def __init__(self, given: Given, frame: Frame, pairs: int) -> None:
        width, height, threshold = frame
        self._given = Given(*(tensor.detach().clone() for tensor in given))
        means2d, conics, opacities, features, depths, extents = self._given
        self._image = features.new_empty(height, width, features.shape[1])
        self._transmittance = features.new_empty(height, width)
        self._pairs = torch.empty(1, dtype=torch.int64, pin_memory=True)
        self._counted, self._stream = torch.cuda.Event(), torch.cuda.current_stream(features.device)
        self._counter = CudaGraphRunner(features.device)
        self._drawer = CudaGraphRunner(features.device, self._counter.stream)

        def count():
            records, counts = pack_gaussians(means2d, conics, opacities, extents, threshold, width, height, features)
            numbered = order_intersections(counts, depths, extents, unsorted=False)
            self._pairs.copy_(numbered[1][-1:], non_blocking=True)
            return records, numbered

        def draw(records, numbered, room: int) -> Adjoint:
            order, ends = numbered
            lists = build_tile_lists(records, order, ends, depths, extents, width, height, room, unsorted=False)
            return blend_on_cuda(features, lists, records, self._image, self._transmittance, threshold, False)

        # Launched once: nothing may be compiled or loaded during a recording, and it tells how much room is needed.
        with self._counter.launching():
            records, numbered = count()
            room = int(ROOM * max(pairs, int(numbered[1][-1])))
            self.room = min(max(LEAST_ROOM, room), MAX_INTERSECTIONS)
            draw(records, numbered, self.room)
            del records, numbered
        records, numbered = self._counter.record(None, count)
        self.adjoint: Adjoint = self._drawer.record(None, lambda: draw(records, numbered, self.room))
        """Of the picture played last; one launch, which needs no recording."""

    def play(self, given: Given) -> tuple[Tensor, Tensor, int]:
        """Image, transmittance and the number of pairs, of which those beyond the room are not drawn."""
        torch._foreach_copy_(list(self._given), list(given))  # pyright: ignore[reportPrivateImportUsage]
        self._counter.replay()
        self._counted.record(self._stream)
        self._drawer.replay()
        drawn = [self._image, self._transmittance, self._given.extents]
        image, transmittance = torch.empty_like(self._image), torch.empty_like(self._transmittance)
        torch._foreach_copy_([image, transmittance, given.extents], drawn)  # pyright: ignore[reportPrivateImportUsage]
        self._counted.synchronize()
        return image, transmittance, int(self._pairs)


@dataclass
class _Kind:
    """Calls with the same sizes: how many were launched, the recordings made, and those that no call holds."""

    launched: int = 0
    made: int = 0
    pairs: int = 0
    idle: list[_Recording] = field(default_factory=list)

    def take(self, record: Callable[[int], _Recording]) -> _Recording | None:
        """A recording that is the caller's until it is idle again; None for a call that is to be launched."""
        with suppress(IndexError):
            return self.idle.pop()
        self.launched += 1
        if self.launched <= WARMUP_CALLS or self.made >= TOGETHER:
            return None
        self.made += 1
        try:
            return record(self.pairs)
        except RuntimeError:
            LOG.debug("a drawing could not be recorded and is launched", exc_info=True)
            self.made = TOGETHER
            return None

    def grow(self, pairs: int) -> None:
        """A recording had no room for so many pairs: new ones shall be made."""
        self.pairs, self.made, self.idle = max(pairs, self.pairs), 0, []


class _Lease:
    """Keeps a recording from other calls for as long as it lives."""

    def __init__(self, idle: list[_Recording], recording: _Recording) -> None:
        self._idle, self._recording = idle, recording

    def adjoint(self, by_image: Tensor, by_transmittance: Tensor | None) -> Tensor:
        return self._recording.adjoint(by_image, by_transmittance)

    def __del__(self) -> None:
        self._idle.append(self._recording)


_lock = threading.Lock()
_kinds: OrderedDict[tuple, _Kind] = OrderedDict()


def forget() -> None:
    """Lets go of all recordings and of their memory."""
    _kinds.clear()


atexit.register(forget)  # Recordings must go before CUDA does.


def _kind(key: tuple) -> _Kind:
    with _lock:
        kind = _kinds.setdefault(key, _Kind())
        _kinds.move_to_end(key)
        while len(_kinds) > KINDS:
            _kinds.popitem(last=False)
    return kind
