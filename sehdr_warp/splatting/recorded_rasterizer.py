"""rasterize() replayed: called like it, at what the GPU needs instead of what Python needs.

A splat is some ten launches, forward and backward each. Called one by one from Python they take longer than a small
picture does; recorded as two CUDA graphs and replayed, what the GPU needs and a few tenths of a millisecond.
"""

from dataclasses import replace
from typing import TypedDict, Unpack

import torch
from torch import Tensor

from .rasterization import Rendering, rasterize
from .recording import GraphRecorder

ROOM = 1.25  # A recording has room for this many times the (Gaussian, tile) pairs of the call before it
LEAST_ROOM = 1 << 12


class Options(TypedDict, total=False):
    """rasterize()'s options, but for capacity, background and depth."""

    near: float
    low_pass: float
    alpha_threshold: float
    antialiased: bool
    deterministic: bool


class RecordedRasterizer:
    """Calls of rasterize() with the same shapes and options, recorded at the first and replayed from then on.

        splat = RecordedRasterizer("cuda:0")
        rendering = splat(means, log_scales, quaternions, opacities, features, pose, intrinsics, width, height)
        loss(rendering.image).backward()

    What a call returns is the recording's own memory: do not write to it. The next call overwrites it, and the backward
    pass must have run before that: RuntimeError otherwise. Other shapes, options or tensors that ask for gradients make
    a new recording. Rendering.means2d is no part of the graph; densification by its gradient needs rasterize().

    device: a CUDA device; raises ValueError for another.
    """

    def __init__(self, device: torch.device | str) -> None:
        self._forward = GraphRecorder(device)
        self._backward = GraphRecorder(device, self._forward.stream)
        self._key = None
        self._arguments: list[Tensor] = []
        self._rendering: Rendering
        self._upstream: list[Tensor] = []
        self._gradients: list[Tensor | None] = []
        self._calls = 0

    def __call__(
        self,
        means: Tensor,
        log_scales: Tensor,
        quaternions: Tensor,
        opacities: Tensor,
        features: Tensor,
        world_to_camera: Tensor,
        intrinsics: Tensor,
        width: int,
        height: int,
        **options: Unpack[Options],
    ) -> Rendering:
        """Arguments and result are rasterize()'s; `capacity`, `background`, `depth` are not among them: TypeError."""
        if unknown := options.keys() - Options.__annotations__.keys():
            raise TypeError(f"a RecordedRasterizer does not take {', '.join(sorted(unknown))}; use rasterize()")
        tensors = means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics
        size = width, height
        wanted = tuple(torch.is_grad_enabled() and tensor.requires_grad for tensor in tensors)
        key = (tuple((tensor.shape, tensor.dtype) for tensor in tensors), wanted, size, tuple(sorted(options.items())))
        if key != self._key:
            self._record(key, tensors, wanted, size, options)
        image, transmittance = _Replay.apply(self, *tensors)
        if self._rendering.overflow:
            # These arguments need more room than those that were recorded.
            self._record(key, tensors, wanted, size, options)
            image, transmittance = _Replay.apply(self, *tensors)
        return replace(self._rendering, image=image, transmittance=transmittance)

    def _record(self, key, tensors, wanted, size, options) -> None:
        self._key = None
        self._arguments = [t.detach().clone().requires_grad_(w) for t, w in zip(tensors, wanted, strict=True)]
        leaves = [tensor for tensor in self._arguments if tensor.requires_grad]

        def forward(capacity=None):
            with torch.set_grad_enabled(bool(leaves)):
                return rasterize(*self._arguments, *size, capacity=capacity, **options)  # pyright: ignore[reportArgumentType]

        def backward(rendering):
            images = [rendering.image, rendering.transmittance]
            return torch.autograd.grad(images, leaves, self._upstream, allow_unused=True)

        # Launched once: nothing may be compiled or loaded during a recording, and it tells how much room is needed.
        with self._forward.launching():
            launched = forward()
            capacity = max(LEAST_ROOM, int(ROOM * launched.entry_count))
            if leaves:
                self._upstream = [torch.zeros_like(launched.image), torch.zeros_like(launched.transmittance)]
                backward(launched)
            del launched
        self._forward.invalidate()
        self._backward.invalidate()
        # Not run(): a recording is made, not played, and the backward pass is recorded on the forward's own graph.
        rendering = self._forward.record(key, lambda: forward(capacity))
        made = iter(self._backward.record(key, lambda: backward(rendering)) if leaves else ())
        self._gradients = [next(made) if want else None for want in wanted]
        made = {name: getattr(rendering, name).detach() for name in ("image", "transmittance", "means2d", "depths")}
        self._rendering = replace(rendering, **made)
        self._key = key


class _Replay(torch.autograd.Function):
    @staticmethod
    def forward(ctx, owner: RecordedRasterizer, *tensors):
        owner._calls += 1
        ctx.owner, ctx.call = owner, owner._calls
        given = [t.detach() for t in tensors]
        torch._foreach_copy_([t.detach() for t in owner._arguments], given)  # pyright: ignore[reportPrivateImportUsage]
        owner._forward.replay()
        ctx.set_materialize_grads(False)
        return owner._rendering.image.detach(), owner._rendering.transmittance.detach()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *upstream):
        owner = ctx.owner
        if ctx.call != owner._calls:
            raise RuntimeError("a RecordedRasterizer was called again before the backward pass of this call; use two")
        for target, gradient in zip(owner._upstream, upstream, strict=True):
            target.zero_() if gradient is None else target.copy_(gradient)
        owner._backward.replay()
        # Copies: torch may keep what it is given as a parameter's gradient, which the next replay would overwrite.
        return None, *(None if gradient is None else gradient.clone() for gradient in owner._gradients)
