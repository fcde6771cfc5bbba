"""A benchmark's result as JSON, as a table for terminals and Markdown, and as a picture."""

from pathlib import Path

import torch

from ..files import atomic_path, check_absent, write_json
from .machine import command_line, describe_machine, now
from .plots import PLOTS

SCHEMA = 1

# Column title, field, format.
_SIZE = (
    ("Gaussians", "gaussians", ",d"),
    ("width", "width", "d"),
    ("height", "height", "d"),
)
_JUDGED = (
    ("method", "method", "s"),
    ("n", "trials", "d"),
    ("mean stops", "mean_error", ".2f"),
    ("worst", "worst_error", ".2f"),
    ("under 0.35", "good", "d"),
)
_DECIBELS = (
    ("gt-max dB", "gt_max_db", ".1f"),
    ("known", "gt_max_known_db", ".1f"),
    ("aligned dB", "aligned_db", ".1f"),
    ("known", "aligned_known_db", ".1f"),
)
# Benchmark, stage, columns.
COLUMNS = {
    "kernels": {
        "splat": (
            *_SIZE,
            ("C", "channels", "d"),
            ("pass", "pass", "s"),
            ("implementation", "implementation", "s"),
            ("median ms", "median_ms", ".3f"),
            ("p90 ms", "p90_ms", ".3f"),
            ("n", "repetitions", "d"),
            ("peak MiB", "peak_memory_bytes", "MiB"),
            ("ours / this", "ours_over_this", ".3f"),
        ),
    },
    "step": {
        "step": (
            ("rasterizer", "implementation", "s"),
            *_SIZE,
            ("median ms", "median_ms", ".3f"),
            ("mean ms", "mean_ms", ".3f"),
            ("with densification", "amortised_ms", ".3f"),
            ("host ms", "host_ms", ".3f"),
            ("device ms", "device_ms", ".3f"),
            ("n", "repetitions", "d"),
            ("peak MiB", "peak_memory_bytes", "MiB"),
            ("ours / this", "ours_over_this", ".4f"),
        ),
    },
    "scale": {
        "scale": (
            ("sweep", "sweep", "s"),
            *_SIZE,
            ("C", "channels", "d"),
            ("implementation", "implementation", "s"),
            ("what", "what", "s"),
            ("median ms", "median_ms", ".3f"),
            ("n", "repetitions", "d"),
            ("peak MiB", "peak_memory_bytes", "MiB"),
            ("entries / tile", "entries_per_tile", ".1f"),
        ),
        "slope": (
            ("sweep", "sweep", "s"),
            ("implementation", "implementation", "s"),
            ("what", "what", "s"),
            ("quantity", "quantity", "s"),
            ("slope", "slope", ".2f"),
            ("from", "from", ",d"),
            ("to", "to", ",d"),
            ("at the large end", "slope_large", ".2f"),
            ("from ", "large_from", ",d"),
        ),
    },
    "training": {
        "training": (
            ("trained by", "implementation", "s"),
            ("iterations", "iterations", ",d"),
            ("PSNR dB", "psnr_ldr", ".2f"),
            ("seconds", "train_seconds", ".1f"),
            ("Gaussians", "gaussians", ",d"),
            ("peak GPU MiB", "peak_gpu_memory_bytes", "MiB"),
        ),
    },
    "response": {
        "scenes": (
            *_JUDGED,
            *_DECIBELS,
        ),
        "scene": (
            ("data", "data", "s"),
            ("truth", "truth", "s"),
            *_JUDGED,
            *_DECIBELS,
            ("chosen", "chosen", "s"),
        ),
        "stacks": (*_JUDGED,),
        "stack": (
            ("data", "data", "s"),
            ("truth", "truth", "s"),
            *_JUDGED,
            ("chosen", "chosen", "s"),
        ),
    },
}


def new_report(benchmark: str, device: torch.device, settings: dict) -> dict:
    """A report without results: benchmark, command, date, machine, settings; rows, checks and notes to be filled."""
    return {
        "schema": SCHEMA,
        "benchmark": benchmark,
        "command": command_line(),
        "date": now(),
        "machine": describe_machine(device),
        "settings": settings,
        "rows": [],
        "checks": [],
        "notes": [],
    }


def format_report(report: dict) -> str:
    """The machine in a line, a table for each stage, the checks in a line, the notes."""
    parts = [_heading(report)]
    for stage, columns in COLUMNS[report["benchmark"]].items():
        rows = [row for row in report["rows"] if row["stage"] == stage]
        if rows:
            shown = [column for column in columns if any(row.get(column[1]) is not None for row in rows)]
            parts.append(
                markdown_table([title for title, _, _ in shown], [[_cell(row, c) for c in shown] for row in rows])
            )
    checks = report["checks"]
    if checks:
        failed = [check for check in checks if not check["passed"]]
        largest = max(checks, key=lambda check: check["difference"] / check["bound"])
        line = f"correctness: {len(checks) - len(failed)} of {len(checks)} checks passed; nearest to its bound: "
        line += f"{largest['what']} against {largest['against']}, {largest['difference']:.1e} of {largest['bound']:.0e}"
        parts.append(line)
    parts += report["notes"]
    return "\n\n".join(parts)


def write_report(report: dict, *, json: Path | None = None, out: Path | None = None, overwrite: bool = False) -> None:
    """Writes the JSON file, and in the folder `out` <benchmark>.json, .md and, where PLOTS has one, .png."""
    if json is not None:
        write_json(json, report, overwrite)
    if out is None:
        return
    name = report["benchmark"]
    write_json(out / f"{name}.json", report, overwrite)
    with atomic_path(out / f"{name}.md", overwrite) as path:
        path.write_text(format_report(report) + "\n", encoding="utf-8")
    if name in PLOTS:
        with atomic_path(out / f"{name}.png", overwrite) as path:
            PLOTS[name](report, path)


def check_writable(benchmark: str, json: Path | None, out: Path | None, overwrite: bool) -> None:
    """Raises InputError for a file that is in the way, before minutes are spent on what could not be written."""
    paths = [] if json is None else [json]
    if out is not None:
        endings = ("json", "md", "png") if benchmark in PLOTS else ("json", "md")
        paths += [out / f"{benchmark}.{ending}" for ending in endings]
    for path in paths:
        check_absent(path, overwrite)


def _heading(report: dict) -> str:
    machine, versions = report["machine"], report["machine"]["versions"]
    place = f"{machine['cpu']}, {machine['usable_cores']} of {machine['cores']} cores"
    if machine["gpu"]:
        place = f"{machine['gpu']['name']} (driver {machine['gpu']['driver']}), {place}"
    packages = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    return f"`{report['command']}`, {report['date']}\n{place}; {packages}"


def _cell(row: dict, column: tuple[str, str, str]) -> str:
    _, key, form = column
    value = row.get(key)
    if value is None:
        return "-"
    if form == "MiB":
        return f"{value / 2**20:.1f}"
    if form == "M":
        return f"{value / 1e6:.1f}"
    return f"{value:{form}}"


def markdown_table(titles: list[str], rows: list[list[str]]) -> str:
    """Aligned Markdown: text columns to the left, numbers to the right."""
    widths = [max(len(line[k]) for line in [titles, *rows]) for k in range(len(titles))]
    text = [all(row[k][:1].isalpha() for row in rows) for k in range(len(titles))]

    def line(cells):
        return "| " + " | ".join(c.ljust(w) if t else c.rjust(w) for c, w, t in zip(cells, widths, text)) + " |"

    rule = "| " + " | ".join("-" * w if t else "-" * (w - 1) + ":" for w, t in zip(widths, text)) + " |"
    return "\n".join([line(titles), rule, *map(line, rows)])
