"""A benchmark's result: rows and checks with the machine and the command that made them; as JSON, and as a table."""

import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import torch

from .. import __version__
from ..errors import SehdrError
from ..files import write_json

SCHEMA = 2
_PACKAGES = ("torch", "warp-lang", "gsplat")


def new_result(benchmark: str, device: torch.device, settings: dict) -> dict:
    """A result to be filled: lists `rows` (of plain values), `checks` and `notes`."""
    return {
        "schema": SCHEMA,
        "benchmark": benchmark,
        "command": shlex.join(["sehdr-warp", *sys.argv[1:]]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": _describe_machine(device),
        "settings": settings,
        "rows": [],
        "checks": [],
        "notes": [],
    }


def _describe_machine(device: torch.device) -> dict:
    """Processor, GPU, driver and versions; what cannot be found out is None."""
    affinity = getattr(os, "sched_getaffinity", None)
    machine = {
        "cpu": _cpu_model(),
        "cores": len(affinity(0)) if affinity else os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {"sehdr-warp": __version__} | {name: _version(name) for name in _PACKAGES},
        "gpu": None,
    }
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        driver = {"driver": _driver_version(), "cuda": torch.version.cuda}
        machine["gpu"] = {"name": properties.name, "memory_bytes": properties.total_memory} | driver
    return machine


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu_model() -> str | None:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return (models or [platform.processor()])[0] or None


def _driver_version() -> str | None:
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.split()[0]
    except (OSError, subprocess.SubprocessError, IndexError):
        return None


def machine_line(result: dict) -> str:
    """Where and with what a result was made, in a line."""
    machine = result["machine"]
    place = f"{machine['cpu']}, {machine['cores']} cores"
    if machine["gpu"]:
        place = f"{machine['gpu']['name']} (driver {machine['gpu']['driver']}), {place}"
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items() if version)
    return f"{place}; {versions}; {result['date'][:10]}"


def check(what: str, against: str, difference: float, bound: float) -> dict:
    """One comparison of a result; a difference that is not a number does not pass."""
    values = {"what": what, "against": against, "difference": difference, "bound": bound}
    return values | {"passed": difference <= bound}


def finish(result: dict, columns: dict[str, str], json: Path | None, overwrite: bool) -> None:
    """Writes and prints a result; columns as markdown_table() takes them. Raises SehdrError for checks that failed,
    after everything is out."""
    if json is not None:
        write_json(json, result, overwrite)
    print(machine_line(result), markdown_table(result["rows"], columns), *result["notes"], sep="\n\n")
    failed = [check for check in result["checks"] if not check["passed"]]
    if not failed:
        return
    count = f"{len(failed)} of {len(result['checks'])}"
    if "error" in failed[0]:
        first = f"{failed[0]['error']} ({failed[0]['what']})"
        raise SehdrError(f"{count} jobs failed, the first with: {first}; the same command tries them again")
    worst = max(failed, key=lambda check: check["difference"] / check["bound"])
    raise SehdrError(
        f"{count} checks failed; the worst: {worst['what']} differs from {worst['against']} by "
        f"{worst['difference']:.1e}, more than {worst['bound']:.0e}: do not use these times"
    )


def markdown_table(rows: Sequence[dict], columns: dict[str, str]) -> str:
    """Aligned Markdown. columns: `field` or `title=field` to a format: as of format(), or MiB, or "" for text; a column
    without any value is left out, and so is a value that a row lacks."""
    parted = [(*key.partition("="), form) for key, form in columns.items()]
    shown = [(title, field or title, form) for title, _, field, form in parted]
    shown = [column for column in shown if any(row.get(column[1]) is not None for row in rows)]
    if not shown:
        return "There are no results."
    lines = [
        [title for title, _, _ in shown],
        *([_cell(row.get(field), form) for _, field, form in shown] for row in rows),
    ]
    widths = [max(2, *map(len, column)) for column in zip(*lines, strict=True)]
    text = [form == "" for _, _, form in shown]
    lines.insert(1, ["-" * w if t else "-" * (w - 1) + ":" for w, t in zip(widths, text, strict=True)])
    padded = ([v.ljust(w) if t else v.rjust(w) for v, w, t in zip(line, widths, text, strict=True)] for line in lines)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in padded)


def _cell(value, form: str) -> str:
    if value is None:
        return "-"
    return f"{value / 2**20:,.0f}" if form == "MiB" else f"{value:{form}}"
