"""The reports: made of stored results, and as they are in the repository."""

import json
import re

import pytest

from benchmarks.quality import plan_jobs, row_of
from benchmarks.report_pages import REPORTS, write_readme, write_reports
from sehdr_warp.errors import InputError

from .test_quality import made_up


def trained(method, decibels, **options):
    """Rows of trainings of a method on the embedded scene, one for each PSNR."""
    planned = plan_jobs(["embedded"], [method], iterations=10, **{"responses": ("known",), **options})
    return [row_of(made_up(job, float(psnr))) for job, psnr in zip(planned, decibels, strict=True)]


def quality_page(folder, rows):
    """Write the reports of a quality result with these rows; return the text of its page."""
    machine = {"cpu": "stub", "cores": 2, "gpu": None, "versions": {"torch": "2"}}
    result = {"command": "-", "machine": machine, "date": "2026-01-01", "rows": rows, "notes": []}
    (folder / "results").mkdir()
    (folder / "results" / "quality.json").write_text(json.dumps(result))
    assert {path.name for path in write_reports(folder)} == {"quality.md", "README.md"}
    return (folder / "quality.md").read_text()


def cells_of(line):
    return [cell.strip() for cell in line.split("|")[1:-1]]


def test_the_pages_are_what_the_results_make(tmp_path):
    """Pages may not be edited by hand: `make reports` makes them."""
    (tmp_path / "results").mkdir()
    for path in (REPORTS / "results").glob("*.json"):
        (tmp_path / "results" / path.name).write_bytes(path.read_bytes())
    # A picture of its own run, not of a result.
    for name in ("tried.csv", "relight.png"):
        (tmp_path / name).write_bytes((REPORTS / name).read_bytes())
    write_reports(tmp_path)
    for page in sorted(REPORTS.glob("*.md")):
        remedy = "edit the result or benchmarks/pages.toml, then run python -m benchmarks.report_pages"
        assert page.read_text() == (tmp_path / page.name).read_text(), f"{page.name} is made of results: {remedy}"
    pages = [
        {path.name for path in folder.iterdir() if path.suffix in (".md", ".png")} for folder in (tmp_path, REPORTS)
    ]
    assert pages[0] == pages[1]


def test_the_readme_shows_the_page_of_quality(tmp_path):
    stored = json.loads((REPORTS / "results" / "quality.json").read_text())
    readme = REPORTS.parents[1] / "README.md"
    (copy := tmp_path / "README.md").write_text(re.sub(r"\d dB \|", "0 dB |", readme.read_text()))
    assert copy.read_text() != readme.read_text()
    write_readme(copy, stored)
    assert copy.read_text() == readme.read_text(), "run python -m benchmarks.report_pages"


def test_quality_is_paired_with_the_upper_bound(tmp_path):
    rows = [
        *trained("default", (30, 28), exposures=(1, 2)),
        *trained("hdr-gs", (20, 22), exposures=(1, 2)),
        *trained("truth", (33, 32), exposures=(1, 2)),
    ]
    lines = quality_page(tmp_path, rows).splitlines()
    cells = {name: values for name, *values in map(cells_of, (line for line in lines if "|" in line))}
    # n, mean, worst, difference to the bound.
    assert cells["default"][:4] == ["2", "29.00", "28.00", "-3.50"]
    assert cells["hdr-gs"][:4] == ["2", "21.00", "20.00", "-11.50"], "a learned curve stands beside the known one"
    assert cells["truth"][:4] == ["2", "32.50", "32.00", "-"]
    short = next(line for line in lines if line.startswith("| default") and "of 7 lights" in line)
    assert short.split("|")[-3].strip() == "0.95" and "0.80 to 1.10" in short  # Of one training's two lights
    assert "## Energy of the lights that photos clip, over the truth's" in lines


def test_what_is_no_result_is_named(tmp_path):
    (tmp_path / "results").mkdir()
    with pytest.raises(InputError, match="holds no results"):
        write_reports(tmp_path)
    (tmp_path / "results" / "step.json").write_text("{}")
    with pytest.raises(InputError, match="is no result"):
        write_reports(tmp_path)


def test_means_over_all_scenes_are_listed_by_seed(tmp_path):
    rows = [
        *trained("default", (30, 28), exposures=(1, 2), seeds=(0,)),
        *trained("default", (31, 29), exposures=(1, 2), seeds=(1,)),
        *trained("truth", (33, 32), exposures=(1, 2), seeds=(0,)),
        *trained("default", (20,), seeds=(2,)),
    ]
    section = quality_page(tmp_path, rows).split("by seed:")[1]
    cells = [cells_of(line) for line in section.splitlines() if line.startswith("| ")]
    assert cells[2:] == [
        ["default", "0", "29.00", "-3.50"],
        ["default", "1", "30.00", "-"],
        ["truth", "0", "32.50", "-"],
    ]


def test_methods_are_compared_where_all_were_trained(tmp_path):
    rows = trained("default", (30, 28, 20), exposures=(1, 2, 3)) + trained("3dgs", (26,), exposures=(2,))
    table = quality_page(tmp_path, rows).split("response known")[1]
    assert "at which every method was trained" in table
    cells = {
        name: values[:3] for name, *values in map(cells_of, (line for line in table.splitlines()[:12] if "|" in line))
    }
    assert cells["default"] == ["1", "28.00", "28.00"] and cells["3dgs"] == ["1", "26.00", "26.00"]
