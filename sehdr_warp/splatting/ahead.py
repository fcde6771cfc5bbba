"""A training's kernels for the CPU, compiled while its photos are read: the compiler takes a quarter of a minute for
them, once on each machine, and a second to find them in the cache."""

import importlib
import logging
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import warp as wp

from ..kernels import blend_cpu, harmonics, plane_sweep_cpu, ssim, tiles, training_step
from ..kernels.constants import ALPHA_THRESHOLD
from ..kernels.project import projection_kernel
from .blending import halvings
from .launching import module_locks
from .memory import check_room_to_compile
from .ssim import CPU_LANES

log = logging.getLogger(__name__)

PATIENCE = 1.0  # Seconds that a block may end in with nothing begun, as one does that refuses its input


def training_kernels(channels: int | None, antialiased: bool) -> list[Any]:
    """Those that take the compiler longest, of which the latest ones are asked for last. channels: that are blended;
    None where that is not known."""
    real = wp.float32
    distance, lists = ssim.ssim_kernels(real, CPU_LANES, True), tiles.tile_kernels(real)
    kind = real, channels, halvings(ALPHA_THRESHOLD)
    blend = [] if channels is None else [blend_cpu.forward_kernel(*kind), blend_cpu.backward_kernel(*kind)]
    return [
        *(
            *blend,
            distance.compare,
            projection_kernel(real, antialiased),
            plane_sweep_cpu.sweep_rows,
            distance.gradient,
        ),
        *(lists.emit_entries, lists.pack_records, distance.blur_columns, distance.blur_derivatives),
        *(harmonics.harmonics_kernel(real, 0), harmonics.harmonics_adjoint_kernel(real, 0, True)),
        *(lists.gather_entries, training_step.add_position_noise, training_step.judge_step),
    ]


@contextmanager
def loaded_ahead(kernels: Sequence[Any], modules: Sequence[str] = ()) -> Iterator[None]:
    """Imports modules and compiles kernels for the CPU, or finds them in the cache, on a thread beside this block,
    which waits for one of them at most, at its end. What fails is told to whoever needs it."""
    over = threading.Event()

    def work() -> None:
        if over.wait(PATIENCE):
            return
        try:
            for name in modules:
                importlib.import_module(name)
            for kernel in kernels:
                if over.is_set():
                    return
                with module_locks[kernel.module]:
                    check_room_to_compile()
                    wp.load_module(kernel.module, device="cpu")
        except Exception:
            log.debug("not all could be loaded ahead", exc_info=True)

    # Not a daemon: what compiles while the interpreter ends would abort the process.
    thread = threading.Thread(target=work, name="sehdr-warp compiles")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
