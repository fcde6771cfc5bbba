"""The reports: made of stored results, and as they are in the repository."""

import json
import re

import pytest

from benchmarks.report_pages import REPORTS, write_readme, write_reports
from sehdr_warp.errors import InputError


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


def test_what_is_no_result_is_named(tmp_path):
    (tmp_path / "results").mkdir()
    with pytest.raises(InputError, match="holds no results"):
        write_reports(tmp_path)
    (tmp_path / "results" / "step.json").write_text("{}")
    with pytest.raises(InputError, match="is no result"):
        write_reports(tmp_path)
