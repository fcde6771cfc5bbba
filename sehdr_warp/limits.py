"""Limits of containers and batch jobs: memory and processors by cgroups (versions 1 and 2) and by Slurm."""

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

PROC, MOUNT = Path("/proc"), Path("/sys/fs/cgroup")
_NO_LIMIT = 1 << 60  # Bytes; version 1 states a number of about 2^63 if there is no limit
_MEMORY_FILES = {
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    2: ("memory.max", "memory.high", "memory.current", "inactive_file"),
}
"""Files of a cgroup by its version: limits, usage, and the field of idle file pages in memory.stat.

Above memory.high, processes are slowed down until they hardly go on.
"""


def memory_left(proc: Path = PROC, mount: Path = MOUNT, environment: Mapping[str, str] | None = None) -> int | None:
    """Return the bytes that this process may still take by the limits of its cgroups and its Slurm job.

    File pages that the kernel would give up are not counted as used.

    Args:
        proc: where the kernel describes processes.
        mount: where cgroups are mounted.
        environment: None is that of the process.

    Returns:
        Bytes, at least 0; None without a limit.
    """
    free = []
    for version, group in _groups(proc, mount, "memory"):
        *limits, usage, idle_pages = _MEMORY_FILES[version]
        limit, used = min(_number(group / name) for name in limits), _number(group / usage)
        if max(limit, used) < _NO_LIMIT:
            free.append(limit - max(0, used - _number(group / "memory.stat", idle_pages)))
    if (job := _slurm_memory(os.environ if environment is None else environment)) is not None:
        free.append(job - _resident(proc))
    return max(0, min(free)) if free else None


def available_memory() -> int:
    """Return the bytes of memory that this process may still take without swapping, as far as the system reports."""
    limits = [1 << 62]
    with suppress(OSError, ValueError, AttributeError):
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with suppress(OSError, StopIteration, ValueError):
        lines = (PROC / "meminfo").read_text().splitlines()
        limits.append(1024 * int(next(line for line in lines if line.startswith("MemAvailable")).split()[1]))
    if (available := memory_left()) is not None:
        limits.append(available)
    return min(limits)


@cache
def processor_limit(proc: Path = PROC, mount: Path = MOUNT) -> int | None:
    """Return the processors that the CPU quotas of the cgroups and a Slurm job leave, rounded up; None without one."""
    limits = []
    for version, group in _groups(proc, mount, "cpu"):
        with suppress(OSError, ValueError, ZeroDivisionError):
            if version == 2:
                quota, period = (group / "cpu.max").read_text().split()
            else:
                quota, period = ((group / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
            if float(quota) > 0:  # ValueError for "max"; -1 is none in version 1.
                limits.append(float(quota) / float(period))
    slurm_cpus = os.environ.get("SLURM_CPUS_PER_TASK", "")
    if slurm_cpus.isdigit() and int(slurm_cpus) > 0:
        limits.append(float(slurm_cpus))
    return max(1, math.ceil(min(limits))) if limits else None


def _groups(proc: Path, mount: Path, controller: str) -> Iterator[tuple[int, Path]]:
    """Yield version and folder of each cgroup with a controller that this process is in, up to the root."""
    with suppress(OSError, ValueError):
        for line in (proc / "self" / "cgroup").read_text().splitlines():
            number, controllers, path = line.split(":", 2)
            if number == "0" and not controllers:
                version, roots = 2, (mount, mount / "unified")
            elif controller in controllers.split(","):
                reverse = ",".join(reversed(controllers.split(",")))
                version, roots = 1, (mount / controllers, mount / reverse, mount / controller)
            else:
                continue
            below = Path(path.lstrip("/"))
            for root in roots:
                for place in (below, *below.parents):  # In a container the path may be the host's.
                    if (root / place).is_dir():
                        yield version, root / place


def _number(path: Path, field: str | None = None) -> int:
    """Return the number in a file, or that of a field in lines of field and number; a missing limit is _NO_LIMIT."""
    try:
        text = path.read_text()
        if field is None:
            return int(text)
        return next(int(line.split()[1]) for line in text.splitlines() if line.startswith(f"{field} "))
    except (OSError, ValueError, StopIteration, IndexError):
        return _NO_LIMIT if field is None else 0


def _slurm_memory(environment: Mapping[str, str]) -> int | None:
    """Return the bytes that a Slurm job requested on this machine; Slurm states megabytes."""
    with suppress(KeyError, ValueError):
        return int(environment["SLURM_MEM_PER_NODE"]) << 20 or None
    for each, count in (("CPU", "SLURM_CPUS_ON_NODE"), ("GPU", "SLURM_GPUS_ON_NODE")):
        with suppress(KeyError, ValueError):
            return (int(environment[f"SLURM_MEM_PER_{each}"]) * int(environment[count])) << 20 or None
    return None


def _resident(proc: Path) -> int:
    with suppress(OSError, ValueError, IndexError, AttributeError):
        return int((proc / "self" / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def format_bytes(count: float) -> str:
    """Return a number of bytes in words of one unit, with two digits."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if count >= size:
            return f"{count / size:.1f} {unit}" if count < 10 * size else f"{count / size:.0f} {unit}"
    return f"{count / 1e3:.0f} KB"
