"""A benchmark's result: rows and checks with the machine and the command that made them; as JSON, and as a table."""

import math
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from sehdr_warp.check.result import new_result as new_package_result
from sehdr_warp.errors import SehdrError
from sehdr_warp.files import write_json

COLUMNS: dict[str, dict[str, str]] = tomllib.loads(Path(__file__).with_name("columns.toml").read_text(encoding="utf-8"))
"""Columns of each benchmark's table, as markdown_table() takes them."""


def new_result(benchmark: str, device: torch.device, settings: dict) -> dict[str, Any]:
    """Return a result to be filled, see check.result.new_result(), of the module that `python -m` started."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    module = spec.name.removesuffix(".__main__") if spec else "benchmarks"
    return new_package_result(benchmark, device, settings, ("python", "-m", module))


def machine_line(result: dict) -> str:
    """Return one line with the machine, the versions and the date of a result."""
    machine = result["machine"]
    place = f"{machine['cpu']}, {machine['cores']} cores"
    if machine["gpu"]:
        place = f"{machine['gpu']['name']} (driver {machine['gpu']['driver']}), {place}"
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items() if version)
    built = f"; build {machine['build']}" if machine.get("build") else ""
    return f"{place}; {versions}{built}; {result['date'][:10]}"


def check(what: str, against: str, difference: float, bound: float) -> dict:
    """Return one comparison of a result; a difference that is not a number counts as infinite."""
    difference = difference if math.isfinite(difference) else math.inf
    values = {"what": what, "against": against, "difference": difference, "bound": bound}
    return values | {"passed": difference <= bound}


def finish(result: dict, json: Path | None = None, overwrite: bool = False) -> None:
    """Write and print a result; then raise SehdrError if a check failed."""
    if json is not None:
        write_json(json, result, overwrite)
    table = markdown_table(result["rows"], COLUMNS[result["benchmark"]])
    parts = [markdown_table(result["parts"], COLUMNS["parts"])] if "parts" in result else []
    print("\n\n".join([machine_line(result), table, *parts, *result["notes"]]))
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
    """Group rows by the values of fields, in the order of the first row of each group."""
    result: dict[tuple, list[Mapping]] = {}
    for row in rows:
        result.setdefault(tuple(row[field] for field in fields), []).append(row)
    return result


def parted(columns: Mapping[str, str]) -> Iterator[tuple[str, str, str]]:
    """(title, field, format) of each column of markdown_table()."""
    for key, form in columns.items():
        title, _, field = key.partition("=")
        yield title, field or title, form


def markdown_table(rows: Sequence[Mapping], columns: Mapping[str, str]) -> str:
    """Return aligned Markdown without columns that have no value in any row.

    columns: `field` or `title=field` to a format: as of format(), or MiB, or "" for text. A value that a row lacks is
    empty.
    """
    used_columns = [column for column in parted(columns) if any(row.get(column[1]) is not None for row in rows)]
    if not used_columns:
        return "There are no results."
    table = []
    for title, field, form in used_columns:
        cells = [title, *(_cell(row.get(field), form) for row in rows)]
        width = max(2, *map(len, cells))
        cells.insert(1, "-" * width if form == "" else "-" * (width - 1) + ":")
        table.append([cell.ljust(width) if form == "" else cell.rjust(width) for cell in cells])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in zip(*table, strict=True))


def _cell(value, form: str) -> str:
    if value is None:
        return "-"
    return f"{value / 2**20:,.0f}" if form == "MiB" else f"{value:{form}}"
