"""CUDA graphs on the CPU: what is captured is run again, so that tests without a GPU see the same logic."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import fields, is_dataclass

import torch
import warp as wp

from sehdr_warp.rasterizer import tile_lists
from sehdr_warp.rasterizer.cuda_graphs import cache, render_graph
from sehdr_warp.rasterizer.warp_launch import packing


class Runner:
    """A CudaGraphRunner whose replays run the function again and copy its results to those of the capture."""

    def __init__(self, device, stream=None):
        self.stream = None

    def on_capture_stream(self):
        return nullcontext()

    def capture(self, key, function):
        self.function, self.result = function, function()
        return self.result

    def replay(self):
        for fixed, new in zip(tensors_of(self.result), tensors_of(self.function()), strict=True):
            if fixed is not new:
                fixed.copy_(new)


def tensors_of(value) -> Iterator[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, tuple | list):
        for item in value:
            yield from tensors_of(item)
    elif is_dataclass(value):
        for item in fields(value):
            yield from tensors_of(getattr(value, item.name))


def emulate(monkeypatch) -> None:
    """Let calls on the CPU be replayed, with block kernels emulated; ordinary kernels must not run in blocks."""
    empty = torch.empty
    monkeypatch.setattr(render_graph, "CudaGraphRunner", Runner)
    monkeypatch.setattr(cache, "on_gpu", lambda tensor: True)
    monkeypatch.setattr(cache, "stream_handle", lambda device: 0)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device=None: None)
    monkeypatch.setattr(torch, "empty", lambda *shape, pin_memory=False, **options: empty(*shape, **options))
    monkeypatch.setattr(tile_lists, "lists_by_tile", tile_lists.sort_by_tile)

    def with_blocks(name, is_block):
        function = getattr(packing.PackedLaunch, name)

        def run(launch, *arguments):
            monkeypatch.setattr(wp.config, "enable_cpu_blocks", is_block(launch, *arguments))
            try:
                return function(launch, *arguments)
            finally:
                monkeypatch.setattr(wp.config, "enable_cpu_blocks", False)

        monkeypatch.setattr(packing.PackedLaunch, name, run)

    with_blocks("__init__", lambda launch, kernel, device, block_dim, *rest: block_dim is not None)
    with_blocks("run", lambda launch, stream: not launch.structures)
