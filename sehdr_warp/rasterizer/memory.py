"""Memory: how much Warp holds beside torch's allocator, and one clear line when there is not enough."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
import warp as wp

from ..errors import SehdrError

try:
    import resource
except ImportError:  # Windows has no limits of this kind.
    resource = None

REMEDY = "use fewer Gaussians (densification.cap_max) or a smaller image (--max-size)"

COMPILER_BYTES = 64 << 20  # Half of it is too little for a kernel of the CPU


class OutOfMemory(SehdrError):
    """Not enough memory; the message gives the sizes and how much was asked for."""


def check_room_to_compile() -> None:
    """Raises MemoryError where the address space is limited and nearly used up: the compiler of kernels would end this
    process, without a word."""
    status = Path("/proc/self/statm")
    if resource is None or not status.exists():
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return
    if limit - int(status.read_text().split()[0]) * resource.getpagesize() < COMPILER_BYTES:
        raise MemoryError(f"the compiler of kernels cannot allocate {COMPILER_BYTES >> 20} MiB")


def warp_memory_bytes(device: torch.device) -> int:
    """Bytes that Warp itself has allocated on a CUDA device at most so far (sorting's scratch); 0 on the CPU."""
    return wp.get_mempool_used_mem_high(wp.device_from_torch(device)) if device.type == "cuda" else 0


def failed_allocation(error: BaseException) -> str | None:
    """How much memory an error says could not be had, as text ("some memory" where it does not say how much); None if
    the error is about something else."""
    text, kinds = str(error), (MemoryError, torch.OutOfMemoryError)
    says_so = re.search(r"can't allocate memory|[Ff]ailed to allocate|out of memory", text)
    if isinstance(error, OutOfMemory) or not (isinstance(error, kinds) or says_so):
        return None
    found = re.search(r"allocate (\d[\d.]*) ?(bytes|[KMGT]iB)", text)
    if found is None:
        return "some memory"
    count, unit = float(found[1]), found[2]
    for larger, size in (("GiB", 1 << 30), ("MiB", 1 << 20)):
        if unit == "bytes" and count >= size:
            return f"{count / size:.2f} {larger}"
    return f"{found[1]} {unit}"


@contextmanager
def oom_context(device: torch.device, sizes: Callable[[], tuple[int, ...]]) -> Iterator[None]:
    """Makes allocations that fail within the block OutOfMemory errors. sizes: Gaussians, width, height and perhaps
    channels by then."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        asked = failed_allocation(error)
        if asked is None:
            raise
        gaussians, width, height, *channels = sizes()
        told = f"{gaussians} Gaussians, an image of {width} x {height}" + "".join(f", {n} channels" for n in channels)
        raise OutOfMemory(f"out of memory on {device}: {asked} could not be allocated with {told}; {REMEDY}") from error
