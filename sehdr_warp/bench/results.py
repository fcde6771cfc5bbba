"""A benchmark's result: rows and checks with the machine and the command that made them; as JSON, and as a table."""

import hashlib
import importlib.metadata
import math
import os
import platform
import shlex
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from torch.utils.collect_env import get_nvidia_driver_version, run

from .. import __version__
from ..errors import SehdrError
from ..files import write_json

SCHEMA = 2
COLUMNS: dict[str, dict[str, str]] = tomllib.loads(Path(__file__).with_name("columns.toml").read_text(encoding="utf-8"))
"""The columns of each benchmark's table, as markdown_table's."""


def new_result(benchmark: str, device: torch.device, settings: dict) -> dict[str, Any]:
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


def _describe_machine(device: torch.device) -> dict[str, Any]:
    """What cannot be found out is None."""
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
        "build": build(),
        "versions": {"sehdr-warp": __version__} | {name: _version(name) for name in ("torch", "warp-lang", "gsplat")},
        "gpu": gpu,
    }


def build() -> str:
    """Eight hexadecimal digits of what the package's code and presets hold: results of one build share them."""
    root, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    paths = (Path(folder, name) for folder, _, names in os.walk(root, followlinks=True) for name in names)
    for path in sorted(path for path in paths if path.suffix in (".py", ".toml")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:8]


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


def machine_line(result: dict) -> str:
    machine = result["machine"]
    place = f"{machine['cpu']}, {machine['cores']} cores"
    if machine["gpu"]:
        place = f"{machine['gpu']['name']} (driver {machine['gpu']['driver']}), {place}"
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items() if version)
    built = f"; build {machine['build']}" if machine.get("build") else ""
    return f"{place}; {versions}{built}; {result['date'][:10]}"


def check(what: str, against: str, difference: float, bound: float) -> dict:
    """One comparison of a result; a difference that is not a number counts as infinite."""
    difference = difference if math.isfinite(difference) else math.inf
    values = {"what": what, "against": against, "difference": difference, "bound": bound}
    return values | {"passed": difference <= bound}


def finish(result: dict, json: Path | None = None, overwrite: bool = False) -> None:
    """Writes and prints a result. Raises SehdrError for checks that failed, after everything is out."""
    if json is not None:
        write_json(json, result, overwrite)
    table = markdown_table(result["rows"], COLUMNS[result["benchmark"]])
    parts = [markdown_table(result["parts"], COLUMNS["parts"])] if "parts" in result else []
    print(machine_line(result), table, *parts, *result["notes"], sep="\n\n")
    failed = [check for check in result["checks"] if not check["passed"]]
    count = f"{len(failed)} of {len(result['checks'])}"
    if failed and "error" in failed[0]:
        first = f"{failed[0]['error']} ({failed[0]['what']})"
        raise SehdrError(f"{count} jobs failed, the first with: {first}; the same command tries them again")
    if failed:
        worst = max(failed, key=lambda check: check["difference"] / check["bound"])
        by = f"{worst['against']} by {worst['difference']:.1e}, more than {worst['bound']:.0e}"
        raise SehdrError(f"{count} checks failed; the worst: {worst['what']} differs from {by}: do not use these times")


def groups(rows: Iterable[Mapping], *fields: str) -> dict[tuple, list[Mapping]]:
    """Rows by the values of these fields, in the order of their first."""
    found: dict[tuple, list[Mapping]] = {}
    for row in rows:
        found.setdefault(tuple(row[field] for field in fields), []).append(row)
    return found


def parted(columns: Mapping[str, str]) -> Iterator[tuple[str, str, str]]:
    """(title, field, format) of each column of markdown_table()."""
    for key, form in columns.items():
        title, _, field = key.partition("=")
        yield title, field or title, form


def markdown_table(rows: Sequence[Mapping], columns: Mapping[str, str]) -> str:
    """Aligned Markdown. columns: `field` or `title=field` to a format: as of format(), or MiB, or "" for text; a column
    without any value is left out, and so is a value that a row lacks."""
    shown = [column for column in parted(columns) if any(row.get(column[1]) is not None for row in rows)]
    if not shown:
        return "There are no results."
    table = []
    for title, field, form in shown:
        cells = [title, *(_cell(row.get(field), form) for row in rows)]
        width = max(2, *map(len, cells))
        cells.insert(1, "-" * width if form == "" else "-" * (width - 1) + ":")
        table.append([cell.ljust(width) if form == "" else cell.rjust(width) for cell in cells])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in zip(*table, strict=True))


def _cell(value, form: str) -> str:
    if value is None:
        return "-"
    return f"{value / 2**20:,.0f}" if form == "MiB" else f"{value:{form}}"
