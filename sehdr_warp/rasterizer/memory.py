"""Memory: how much Warp holds beside torch's allocator, and one clear line when there is not enough."""

import ctypes
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import warp as wp

from ..errors import SehdrError
from ..limits import available_memory

try:
    import resource
except ImportError:  # Windows has no limits of this kind.
    resource = None

REMEDY = "use fewer Gaussians or a smaller image"
TRAINING_REMEDY = "use fewer Gaussians (densification.cap_max) or a smaller image (--max-size)"

COMPILER_BYTES = 64 << 20  # Half of it is too little for a kernel of the CPU
LARGE = 1 << 30  # Bytes; asking the system about fewer would take longer than a small render


class OutOfMemory(SehdrError):
    """Not enough memory; the message gives the sizes and how much was requested.

    Attributes:
        details: the message without the remedy.
    """

    def __init__(self, details: str, remedy: str = REMEDY) -> None:
        """Compose the message; remedy says what to do."""
        super().__init__(f"{details}; {remedy}")
        self.details = details


def check_room_to_compile() -> None:
    """Raise MemoryError if the address space is limited and nearly used up: the compiler would end this process."""
    status = Path("/proc/self/statm")
    if resource is None or not status.exists():
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return
    if limit - int(status.read_text().split()[0]) * resource.getpagesize() < COMPILER_BYTES:
        raise MemoryError(f"the compiler of kernels cannot allocate {COMPILER_BYTES >> 20} MiB")


def check_room(count: int) -> None:
    """Raise MemoryError for many bytes that the system cannot give: Linux ends a process that writes to them."""
    if count < LARGE or count <= available_memory():
        return
    return_freed_memory()  # What a training keeps of its last step, and the system does not count as available
    if count > available_memory():
        raise MemoryError(f"the system cannot allocate {count} bytes")


def return_freed_memory() -> None:
    """Return freed memory that glibc keeps in the process to the system; does nothing on other systems."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)


def warp_memory_bytes(device: torch.device) -> int:
    """Return the most bytes that Warp itself has allocated on a CUDA device so far, as scratch; 0 on the CPU."""
    return wp.get_mempool_used_mem_high(wp.device_from_torch(device)) if device.type == "cuda" else 0


def failed_allocation(error: BaseException) -> str | None:
    """Return how much memory an error says could not be allocated, as text; None if it is about something else.

    If the error does not say how much, it is "some memory".
    """
    text, kinds = str(error), (MemoryError, torch.OutOfMemoryError)
    says_so = re.search(r"can't allocate memory|[Ff]ailed to allocate|out of memory", text)
    if isinstance(error, OutOfMemory) or not (isinstance(error, kinds) or says_so):
        return None
    match = re.search(r"allocate (\d[\d.]*) ?(bytes|[KMGT]iB)", text)
    if match is None:
        return "some memory"
    count, unit = float(match[1]), match[2]
    for larger, size in (("GiB", 1 << 30), ("MiB", 1 << 20)):
        if unit == "bytes" and count >= size:
            return f"{count / size:.2f} {larger}"
    return f"{match[1]} {unit}"


class oom_context:
    """Turn allocations that fail within the block into OutOfMemory errors that name the sizes.

    Args:
        device: of the work.
        sizes: returns the number of Gaussians, width, height and, if known by then, channels.
        remedy: what the user can do, also in place of the remedy of an OutOfMemory error from within.
    """

    __slots__ = ("_device", "_remedy", "_sizes")

    def __init__(self, device: torch.device, sizes: Callable[[], tuple[int, ...]], remedy: str = REMEDY) -> None:
        """Make a context for one piece of work."""
        self._device, self._sizes, self._remedy = device, sizes, remedy

    def __enter__(self) -> None:
        """Enter the block."""

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        """Raise OutOfMemory for an error about memory."""
        if isinstance(error, OutOfMemory) and self._remedy not in str(error):
            raise OutOfMemory(error.details, self._remedy) from error
        if not isinstance(error, RuntimeError | MemoryError):
            return
        request = failed_allocation(error)
        if request is None:
            return
        gaussians, width, height, *channels = self._sizes()
        work = f"{gaussians} Gaussians, an image of {width} x {height}" + "".join(f", {n} channels" for n in channels)
        details = f"out of memory on {self._device}: {request} could not be allocated with {work}"
        raise OutOfMemory(details, self._remedy) from error
