"""Tables of the page of quality."""

import json

from benchmarks.quality import plan_jobs, row_of
from benchmarks.report_pages import write_reports

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
