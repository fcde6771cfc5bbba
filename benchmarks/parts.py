"""The parts of a recorded training step: the GPU's time for each, and the least that memory and schedulers allow."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from sehdr_warp.quiet import silent_stderr

from .timing import Variant
from .workload import count_blended_pairs

STEPS = 20  # Number of profiled steps
COPIED = 1 << 28  # Bytes of the copy that measures the bandwidth of the memory
CYCLES = 20_000_000  # Cycles that a kernel idles to measure the clock
SCHEDULERS = 4  # In a multiprocessor; each issues one instruction of a warp in a cycle
OTHER = "torch's own"

KERNELS = {
    "projection": ("project_*_forward",),
    "harmonics": ("evaluate_*", "jacobian_backward_*"),
    "lists": ("pack_splats_*", "key_by_*", "emit_*", "find_tile_ranges_*", "*radix_sort*", "*DeviceScan*"),
    "blend": ("blend_forward_*",),
    "response and fusion": (
        "encode_*",
        "interpolate_*",
        "perceptrons_*",
        "mix_*",
        "point_backward_*",
        "unit_backward_*",
    ),
    "losses": ("compare_*", "gradient_in_*", "clipped_*", "code_residual_*", "sum_opacities*"),
    "blend, backward": ("blend_backward_*",),
    "projection, backward": ("project_*_backward",),
    "optimizer": ("update_*", "find_nonfinite_*", "decide_step_*"),
    "densification": ("add_position_noise_*", "add_gradient_statistics_*"),
    OTHER: ("*",),
}
"""Patterns of the kernels of each part; a kernel belongs to the first part with a pattern that fits."""


@dataclass(frozen=True)
class Work:
    """The amount of work of a step."""

    gaussians: int  # Gaussians
    harmonics: int  # Numbers of a Gaussian's harmonics
    channels: int  # Features that are blended
    pairs: int  # Pairs of a Gaussian and a tile
    warp_pairs: int  # Pairs of a Gaussian and a warp that blends it
    pixels: int  # Of the image


FLOAT = 4
GEOMETRY, PROJECTED, PACKED = 11, 9, 8  # Numbers of a Gaussian, of its projection, of what the blend reads of it

BYTES: dict[str, Callable[[Work], float]] = {
    "projection": lambda w: FLOAT * w.gaussians * (GEOMETRY + PROJECTED),
    "harmonics": lambda w: FLOAT * w.gaussians * (w.harmonics + 3 + 3),
    # Packed Gaussians, prefix sums; keys of 8 bytes and values of 4, written, read by one sort, and written by it.
    "lists": lambda w: w.gaussians * (FLOAT * (PROJECTED + PACKED) + 16) + 36 * w.pairs,
    "blend": lambda w: FLOAT * (w.pairs + w.gaussians * (PACKED + w.channels) + w.pixels * (w.channels + 2)),
    # A code, an image and its gradient.
    "losses": lambda w: 3 * w.pixels * (1 + 2 * FLOAT),
    "blend, backward": lambda w: (
        FLOAT * (w.pairs + w.gaussians * (PACKED + 2 * w.channels + 6) + w.pixels * (w.channels + 2))
    ),
    "projection, backward": lambda w: FLOAT * w.gaussians * (2 * GEOMETRY + 6),
    # Parameters and both moments, read and written; the harmonics' gradients are made of three numbers.
    "optimizer": lambda w: FLOAT * w.gaussians * (6 * (GEOMETRY + w.harmonics) + GEOMETRY + 3),
}
"""Fewest bytes that each part moves if it reads nothing twice."""

INSTRUCTIONS: dict[str, Callable[[Work], float]] = {
    "blend": lambda w: w.warp_pairs * (28 + 1.25 * (w.channels - 3)),
    "blend, backward": lambda w: w.warp_pairs * (49 + 2.25 * (w.channels - 3)),
}
"""Fewest instructions that warps issue: those of sm_90's code for a Gaussian in a warp with three channels, and one
multiply-add and a fourth of a load for each further channel; the backward pass sums once more."""


def part_of(kernel: str) -> str:
    """Return the part that a kernel belongs to, by its name in the profiler."""
    name = kernel.rpartition("__locals__")[2]  # Behind the function that made it
    return next(part for part, patterns in KERNELS.items() if any(fnmatchcase(name, p) for p in patterns))


def parts_of_step(variant: Variant, work: Work, device: torch.device) -> list[dict]:
    """Return a row for each part of a step on a GPU.

    A row has launches, microseconds, and the microseconds that its bytes and its instructions take at least; None if no
    bound is known.
    """
    for _ in range(STEPS):
        variant.once()
    torch.cuda.synchronize(device)
    with silent_stderr(), profile(activities=[ProfilerActivity.CUDA]) as profiler:
        for _ in range(STEPS):
            variant.once()
        torch.cuda.synchronize(device)
    times: dict[str, float] = defaultdict(float)
    launches: dict[str, int] = defaultdict(int)
    events: Any = profiler.events()
    for event in events:
        if event.device_type == torch.autograd.DeviceType.CUDA:
            part = part_of(event.name)
            times[part] += event.time_range.elapsed_us() / STEPS
            launches[part] += 1
    memory, issued = bytes_per_microsecond(device), instructions_per_microsecond(device)
    rows = []
    for part in (part for part in KERNELS if launches[part]):
        row = {"part": part, "launches": launches[part] / STEPS, "microseconds": times[part]}
        if part in BYTES:
            least = BYTES[part](work)
            row |= {"least_megabytes": least / 1e6, "memory_microseconds": least / memory}
        if part in INSTRUCTIONS:
            row["issue_microseconds"] = INSTRUCTIONS[part](work) / issued
        bounds = [row[name] for name in ("memory_microseconds", "issue_microseconds") if name in row]
        rows.append(row | ({"over_bound": times[part] / max(bounds)} if bounds else {}))
    return rows


def work_of(arguments: Sequence[Any], harmonics: int) -> Work:
    """arguments: rasterize()'s, seven tensors, width and height; harmonics: numbers of a Gaussian's."""
    *splats, width, height = arguments
    pairs, warp_pairs = count_blended_pairs(splats, width, height)
    return Work(len(splats[0]), harmonics, splats[4].shape[1], pairs, warp_pairs, width * height)


def bytes_per_microsecond(device: torch.device) -> float:
    """Measure what the memory moves in a copy: bytes read and written."""
    source = torch.zeros(COPIED, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    return 2 * COPIED / _microseconds(lambda: target.copy_(source))


def instructions_per_microsecond(device: torch.device) -> float:
    """Return the bound at which all schedulers issue at the clock that the GPU runs at."""
    processors = torch.cuda.get_device_properties(device).multi_processor_count
    clock = CYCLES / _microseconds(lambda: torch.cuda._sleep(CYCLES))  # pyright: ignore[reportPrivateUsage]
    return processors * SCHEDULERS * clock


def _microseconds(action: Callable[[], object]) -> float:
    """Measure the least time of an action."""
    action()
    times = []
    for _ in range(5):
        first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        first.record()
        action()
        last.record()
        last.synchronize()
        times.append(first.elapsed_time(last) * 1e3)
    return min(times)
