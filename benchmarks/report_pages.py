"""Write the pages and plots of docs/reports from the results stored there. Nothing in them is typed by hand.

python -m benchmarks.report_pages
"""

import csv
from collections.abc import Sequence
from pathlib import Path

from sehdr_warp.errors import InputError
from sehdr_warp.files import atomic_path, read_json

from .quality_tables import FIRST_TITLE, quality_tables, readme_table
from .report_plots import plot_kernels
from .report_tables import PAGES, TABLES
from .results import groups, machine_line, markdown_table
from .study import run

ROOT = Path(__file__).resolve().parents[1]
REPORTS = ROOT / "docs" / "reports"


def write_reports(folder: Path) -> list[Path]:
    """Write a page, with its plot, for each result in folder/results and for folder/tried.csv, and an index.

    Raises InputError for a folder without results, and for a result that cannot be read.
    """
    result_files = {name: path for name in PAGES if (path := folder / "results" / f"{name}.json").is_file()}
    if not result_files:
        raise InputError(folder, "holds no results", "store them as results/*.json")
    pages, index = [], []
    for name, path in result_files.items():
        page, result = PAGES[name], _read(path)
        tables = quality_tables if name == "quality" else TABLES[name]
        parts = [f"# {page['title']}", page["text"], f"```sh\n{result['command']}\n```"]
        if "command" in page:
            folder_of_results = " (`$out` is a folder in `measured/`)" if "$out" in result["command"] else ""
            parts += [f"Measure again: `python -m benchmarks.measure {name}`{folder_of_results}."]
        parts += [machine_line(result) + "."]
        if name == "kernels":
            pages.append(folder / "kernels.png")
            with atomic_path(pages[-1], internal=True) as temporary:
                plot_kernels(result, temporary)
        if "caption" in page and (folder / f"{name}.png").is_file():
            parts.append(f"![{page['caption']}]({name}.png)")
        pages.append(_write(folder / f"{name}.md", [*parts, *tables(result), *result["notes"]]))
        machine = result["machine"]
        place = machine["gpu"]["name"] if machine["gpu"] else f"{machine['cpu']}, {machine['cores']} cores"
        build = machine.get("build")
        index.append({"report": f"[{page['title']}]({name}.md)", "machine": place, "build": build})
    if (folder / "tried.csv").is_file():
        pages.append(_write(folder / "tried.md", _tried_page(folder / "tried.csv")))
        index.append({"report": f"[{PAGES['tried']['title']}](tried.md)"})
    text = (
        "Measurements, each with its commands, machine and build. `python -m benchmarks.measure PAGE` measures a page "
        "again. `python -m benchmarks.report_pages` writes the pages and the README's table from the results."
    )
    table = markdown_table(index, {"report": "", "machine": "", "build": ""})
    return [*pages, _write(folder / "README.md", ["# Reports", text, table])]


def _read(path: Path) -> dict:
    result = read_json(path)
    if missing := {"command", "machine", "date", "rows", "notes"} - result.keys():
        raise InputError(path, f"is no result (lacks {min(missing)})", "write it with --json of a benchmark")
    return result


def _write(path: Path, parts: Sequence[str]) -> Path:
    with atomic_path(path, internal=True) as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return path


def write_readme(path: Path, result: dict) -> None:
    """Write the figures of the page of quality into the table of the README."""
    text, table = path.read_text(encoding="utf-8"), readme_table(result["rows"])
    start = text.index(f"| {FIRST_TITLE} |")
    with atomic_path(path, internal=True) as temporary:
        temporary.write_text(text[:start] + table + text[text.index("\n\n", start) :], encoding="utf-8")


def _tried_page(path: Path) -> list[str]:
    with open(path, newline="", encoding="utf-8") as file:
        topics = groups(csv.DictReader(file), "topic")
    columns: dict[str, str] = dict.fromkeys(("option", "idea", "gave", "on"), "")
    tables = [part for (topic,), rows in topics.items() for part in (f"## {topic}", markdown_table(rows, columns))]
    page = PAGES["tried"]
    return [f"# {page['title']}", page["text"], *tables]


def main() -> None:
    """Write the pages and the README's table."""
    print(*write_reports(REPORTS), sep="\n")
    write_readme(ROOT / "README.md", _read(REPORTS / "results" / "quality.json"))


if __name__ == "__main__":
    run(main)
