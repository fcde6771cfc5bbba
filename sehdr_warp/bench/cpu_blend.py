"""The CPU's blend alone: nanoseconds for each pixel-Gaussian pair, on one thread and on two."""

import math
import os
import time
from contextlib import contextmanager

import torch

from ..kernels.constants import ALPHA_THRESHOLD, TILE_SIZE
from ..splatting.blending import blend
from ..splatting.tile_lists import TileLists
from .splats import Size, SplatScene
from .stages import Prepared, prepare
from .timing import Variant, time_variants

BLEND_THREADS = (1, 2)


def blend_rows(scene: SplatScene, name: str, repetitions: int, budget: float) -> list[dict]:
    """Rows of one scene, called `name`: forward and backward on each of BLEND_THREADS.

    ns_per_pair is of the median, least_ns_per_pair of the least time; cpu_ns_per_pair of the least processor time,
    which leaves out when others had the core (one thread only).
    """
    prepared = prepare(scene)
    lists, inputs, options = prepared.lists, prepared.blend_inputs, prepared.options
    pairs, counted = listed_pairs(lists, scene.size), counted_pairs(prepared, scene.size)
    cotangent = scene.cotangent()
    variants = {}
    for threads in BLEND_THREADS:
        variants["forward", threads] = _forward(inputs, options, threads)
        variants["backward", threads] = _backward(inputs, options, cotangent, threads)
    timings = time_variants(variants, scene.device, repetitions=repetitions, budget=budget)
    rows = []
    for (passes, threads), timing in timings.items():
        figures = timing.to_dict()
        cpu = processor_seconds(variants[passes, threads], figures["repetitions"]) if threads == 1 else None
        rows.append(
            {
                "stage": "blend",
                "scene": name,
                "gaussians": scene.size.gaussians,
                "width": scene.size.width,
                "height": scene.size.height,
                "channels": scene.channels,
                "implementation": "sehdr-warp",
                "pass": passes,
                "threads": threads,
                "entries": lists.entry_count,
                "pairs": pairs,
                "counted_pairs": counted,
                "ns_per_pair": timing.median * 1e6 / max(1, pairs),
                "ns_per_counted_pair": timing.median * 1e6 / max(1, counted),
                "least_ns_per_pair": figures["min_ms"] * 1e6 / max(1, pairs),
                "cpu_ns_per_pair": None if cpu is None else cpu * 1e9 / max(1, pairs),
                "speedup_over_one_thread": timings[passes, 1].to_dict()["min_ms"] / figures["min_ms"],
            }
            | figures
        )
    return rows


def processor_seconds(variant: Variant, repetitions: int) -> float:
    """The least processor time that a variant took, of so many runs."""
    least = math.inf
    for _ in range(repetitions):
        prepared = variant.prepare()
        started = time.process_time()
        variant.run(prepared)
        least = min(least, time.process_time() - started)
    return least


def listed_pairs(lists: TileLists, size: Size) -> int:
    """Pixel-Gaussian pairs: for each tile, the entries of its list times its pixels within the image."""
    entries = (lists.ranges[:, 1] - lists.ranges[:, 0]).long().cpu().reshape(lists.rows, lists.columns)
    across = torch.full((lists.columns,), TILE_SIZE)
    across[-1] = size.width - (lists.columns - 1) * TILE_SIZE
    down = torch.full((lists.rows,), TILE_SIZE)
    down[-1] = size.height - (lists.rows - 1) * TILE_SIZE
    return int((entries * down[:, None] * across[None, :]).sum())


def counted_pairs(prepared: Prepared, size: Size) -> int:
    """Of listed_pairs(), those where alpha reaches the threshold: what no algorithm may leave out (but behind pixels
    that are finished)."""
    lists, (shapes, ellipses) = prepared.lists, prepared.options["records"]
    tiles = torch.repeat_interleave(
        torch.arange(lists.ranges.shape[0]), (lists.ranges[:, 1] - lists.ranges[:, 0]).long()
    )
    offsets = torch.arange(TILE_SIZE) + 0.5
    total = 0
    for tile, gaussian in zip(tiles.split(20_000), lists.gaussians.long().split(20_000)):
        x = (tile % lists.columns * TILE_SIZE)[:, None, None] + offsets[None, None, :]
        y = (tile // lists.columns * TILE_SIZE)[:, None, None] + offsets[None, :, None]
        shape, ellipse = shapes[gaussian].T[:, :, None, None], ellipses[gaussian].T[:, :, None, None]
        dx, dy = shape[0] - x, shape[1] - y
        exponent = -0.5 * (ellipse[0] * dx * dx + ellipse[2] * dy * dy) - ellipse[1] * dx * dy
        reached = shape[2] * exponent.clamp(max=0.0).exp() >= ALPHA_THRESHOLD
        total += int((reached & (x < size.width) & (y < size.height)).sum())
    return total


def _forward(inputs, options, threads: int) -> Variant:
    def run(_):
        with torch.no_grad(), using_threads(threads):
            blend(*inputs, **options)

    return Variant(run)


def _backward(inputs, options, cotangent, threads: int) -> Variant:
    def run(image):
        with using_threads(threads):
            image.backward(cotangent)

    def prepare():
        for tensor in inputs:
            tensor.grad = None
        return blend(*inputs, **options)[0]

    return Variant(run, prepare)


@contextmanager
def using_threads(count: int):
    """The CPU's kernels run on so many threads (SEHDR_THREADS) within this block."""
    before = os.environ.get("SEHDR_THREADS")
    os.environ["SEHDR_THREADS"] = str(count)
    try:
        yield
    finally:
        if before is None:
            del os.environ["SEHDR_THREADS"]
        else:
            os.environ["SEHDR_THREADS"] = before
