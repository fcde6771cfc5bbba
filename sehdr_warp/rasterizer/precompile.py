"""Compile a training's CPU kernels while its photos are read.

The compiler takes some ten seconds for them, once on each machine, and a second to find them in the cache.
"""

import importlib
import logging
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import warp as wp

from ..kernels import (
    blend_cpu,
    harmonics,
    plane_sweep,
    plane_sweep_cpu,
    relocation,
    residual_sampling,
    shared_ranges,
    ssim,
    step_updates,
    tiles,
)
from ..kernels.constants import ALPHA_THRESHOLD
from ..kernels.project import projection_kernel
from .blending import exp_squarings
from .losses.ssim import CPU_LANES
from .warp_launch.loading import compile_for_cpu, uses_fused_multiply_add

log = logging.getLogger(__name__)

PATIENCE = 0.2  # Seconds that a block may end in with nothing begun, as one does that refuses its input


def training_kernels(channels: int | None, antialiased: bool) -> list[Any]:
    """Return the kernels that take the compiler longest, about in the order of their first launches.

    channels: that are blended; None if not known.
    """
    real = wp.float32
    distance, lists = ssim.ssim_kernels(real, CPU_LANES, True), tiles.tile_kernels(real)
    kind = real, channels, exp_squarings(ALPHA_THRESHOLD)
    blend = [] if channels is None else [blend_cpu.backward_kernel(*kind), blend_cpu.forward_kernel(*kind)]
    return [
        *(shared_ranges.share_ranges, plane_sweep_cpu.sweep_rows, plane_sweep.trust_depths, plane_sweep.place_matches),
        *(*blend, projection_kernel(real, antialiased, False, False), distance.compare),
        *(harmonics.harmonics_kernel(real, 0), lists.pack_splats, lists.turn_depths, lists.key_by_depth),
        lists.emit_by_depth,
        *(tiles.count_tiles, tiles.place_intersections, distance.blur_columns),
        *(distance.blur_derivatives, distance.gradient),
        *(lists.gather_intersections, harmonics.harmonics_backward_kernel(real, 0, True)),
        *(step_updates.decide_step, step_updates.add_position_noise),
        *(relocation.number_slots, relocation.count_copies, relocation.share_opacities, relocation.copy_rows),
        *(relocation.scale_rows, residual_sampling.error_weights_kernel(wp.uint8), residual_sampling.sampled_pixels),
    ]


@contextmanager
def precompiled(kernels: Sequence[Any], modules: Sequence[str] = ()) -> Iterator[None]:
    """Import modules and compile CPU kernels, or load them from the cache, on two threads beside the block.

    At its end the block waits for at most one of them on each thread. Failures are left to whoever needs the module or
    kernel.
    """
    over = threading.Event()
    fused = [kernel for kernel in kernels if uses_fused_multiply_add(kernel)]

    def work(kernels: Sequence[Any], modules: Sequence[str]) -> None:
        if over.wait(PATIENCE):
            return
        try:
            for name in modules:
                importlib.import_module(name)
            for kernel in kernels:
                if over.is_set():
                    return
                compile_for_cpu(kernel)
        except Exception:
            log.debug("not all could be loaded ahead", exc_info=True)

    # Not daemons: what compiles while the interpreter ends would abort the process.
    shares = (fused, modules), ([kernel for kernel in kernels if kernel not in fused], ())
    workers = [threading.Thread(target=work, args=each, name="sehdr-warp ahead") for each in shares]
    for worker in workers:
        worker.start()
    try:
        yield
    finally:
        over.set()
        for worker in workers:
            worker.join()
