"""The result of a measurement: rows and checks, with the machine and the command that produced them."""

import importlib.metadata
import os
import platform
import shlex
import sys
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from torch.utils.collect_env import get_nvidia_driver_version, run

from .. import __version__
from ..caches import package_hash

SCHEMA = 2


def new_result(
    benchmark: str, device: torch.device, settings: dict, program: tuple[str, ...] = ("sehdr-warp",)
) -> dict[str, Any]:
    """Return a result to be filled, with empty lists "rows" (of plain values), "checks" and "notes".

    Args:
        benchmark: the name of what is measured.
        device: the device that is measured; its description goes into "machine".
        settings: plain values that change what is measured.
        program: the words before the arguments of this process, for "command".
    """
    return {
        "schema": SCHEMA,
        "benchmark": benchmark,
        "command": shlex.join([*program, *sys.argv[1:]]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": _describe_machine(device),
        "settings": settings,
        "rows": [],
        "checks": [],
        "notes": [],
    }


def _describe_machine(device: torch.device) -> dict[str, Any]:
    """Return the hardware and the versions in use; a value that cannot be found out is None."""
    gpu = None
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        driver = {"driver": get_nvidia_driver_version(run), "cuda": torch.version.cuda}
        gpu = {"name": properties.name, "memory_bytes": properties.total_memory} | driver
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "build": package_hash(),
        "versions": {"sehdr-warp": __version__} | {name: _version(name) for name in ("torch", "warp-lang", "gsplat")},
        "gpu": gpu,
    }


def _version(package: str) -> str | None:
    with suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(package)
    return None


def _cpu_model() -> str | None:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or None
