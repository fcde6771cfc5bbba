"""Time and memory of calls. Variants take turns, so that changes of the machine's speed affect all of them alike."""

import gc
import math
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch.profiler import ProfilerActivity, profile

from sehdr_warp.quiet import silent_stderr
from sehdr_warp.rasterizer.memory import warp_memory_bytes

LEAST_REPETITIONS = 3
BUDGET = 10.0  # Seconds that one variant may take on the CPU; a slow one runs less often
TURNS = 3  # Number of turns into which the repetitions of each variant are divided


@dataclass(frozen=True)
class Variant:
    """One thing to time. prepare() runs before every run() and is not timed."""

    run: Callable[[], object]
    prepare: Callable[[], object] = lambda: None

    def once(self) -> None:
        """Run once."""
        self.prepare()
        self.run()


def time_variants(
    variants: dict[str, Variant],
    device: torch.device,
    *,
    repetitions: int = 30,
    budget: float = BUDGET,
    apart: bool = False,
) -> dict[str, dict]:
    """Time variants in turns; see summary().

    On a GPU an event stands before and after each run, with the device idle before, so that the host's time counts if
    it is the limit. If `apart`, a summary then has also `host_ms`, the median until a run returns to Python.
    """
    samples: dict[str, list[float]] = {name: [] for name in variants}
    returned: dict[str, list[float]] = {name: [] for name in variants}
    repetitions_left = dict.fromkeys(variants, repetitions)
    for name, variant in variants.items():
        for _ in range(8 if device.type == "cuda" else 2):
            variant.once()
        if device.type == "cpu":
            affordable = int(budget / max(_milliseconds(variant, device).whole / 1e3, 1e-9))
            repetitions_left[name] = min(repetitions, max(LEAST_REPETITIONS, affordable))
    for turn in range(TURNS):
        for name, variant in variants.items():
            # The first run of a turn finds caches full of another variant's data, and is not timed.
            variant.once()
            for _ in range(repetitions_left[name] * (turn + 1) // TURNS - repetitions_left[name] * turn // TURNS):
                whole, host = _milliseconds(variant, device)
                samples[name].append(whole)
                returned[name].append(host)
    summaries = {name: summary(values) for name, values in samples.items()}
    if apart and device.type == "cuda":
        for name, values in returned.items():
            summaries[name] |= {"host_ms": statistics.median(values)}
    return summaries


def summary(samples: list[float]) -> dict:
    """Median, mean, least and 90th percentile in ms, and the number of repetitions."""
    ordered = sorted(samples)
    return {
        "median_ms": statistics.median(ordered),
        "mean_ms": statistics.fmean(ordered),
        "min_ms": ordered[0],
        "p90_ms": ordered[math.ceil(0.9 * len(ordered)) - 1],
        "repetitions": len(ordered),
    }


class Milliseconds(NamedTuple):
    """Time of one run, and until it returned to Python."""

    whole: float
    host: float


def _milliseconds(variant: Variant, device: torch.device) -> Milliseconds:
    variant.prepare()
    if device.type == "cpu":
        started = time.perf_counter()
        variant.run()
        whole = (time.perf_counter() - started) * 1e3
        return Milliseconds(whole, whole)
    first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    wait(device)
    first.record(torch.cuda.current_stream(device))
    started = time.perf_counter()
    variant.run()
    host = (time.perf_counter() - started) * 1e3
    last.record(torch.cuda.current_stream(device))
    last.synchronize()
    return Milliseconds(first.elapsed_time(last), host)


def kernel_milliseconds(variant: Variant) -> float:
    """Return the time of a run's kernels and copies on the GPU, in the mean of five runs.

    The process is slower at launching kernels from then on.
    """
    torch.cuda.synchronize()
    with silent_stderr(), profile(activities=[ProfilerActivity.CUDA]) as recorded:
        for _ in range(5):
            variant.once()
        torch.cuda.synchronize()
    return sum(event.self_device_time_total for event in recorded.key_averages()) / 5 / 1e3


def wait(device: torch.device) -> None:
    """Wait until a GPU is idle; return at once on the CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def forget_peaks(device: torch.device) -> None:
    """Reset the peaks of memory, so that earlier measurements do not count."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.init()  # before a first use torch has no peaks to forget, and says so by an error
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def held_memory(device: torch.device) -> int | None:
    """Return the most memory that torch and Warp had at once since forget_peaks(), bytes; None on the CPU."""
    return torch.cuda.max_memory_allocated(device) + warp_memory_bytes(device) if device.type == "cuda" else None


def peak_memory(variant: Variant, device: torch.device) -> int:
    """Return the largest memory of torch's allocator during one run above what was in use before it, bytes."""
    variant.prepare()
    if device.type == "cuda":
        wait(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        variant.run()
        wait(device)
        return torch.cuda.max_memory_allocated(device) - before
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # the profiler's own messages are not the user's
    # It warns of what was allocated before, which is none of this.
    with silent_stderr(), profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        variant.run()
    # In the order of time; events() of the profiler leaves out what is freed within the operation that allocated it.
    profiler: Any = recorded.profiler
    events = profiler.kineto_results.events()
    changes = [(event.start_ns(), event.nbytes()) for event in events if event.name() == "[memory]"]
    return max(accumulate(nbytes for _, nbytes in sorted(changes)), default=0)
