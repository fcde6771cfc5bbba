"""Runs side by side, and folders of pictures against truth."""

import csv
from types import SimpleNamespace

import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.evaluation.compare import compare_runs, comparison_csv, comparison_latex, comparison_table
from sehdr_warp.runs.config import Config


def trained(path, *, seed=0, iterations=100, ldr=(20.0, 25.0), mu=(None, 30.0)):
    lines = [
        {"iteration": 50 * i, "seconds": 4.0 * i, "psnr_ldr": a, "psnr_mu": b}
        for i, (a, b) in enumerate(zip(ldr, mu, strict=True), 1)
    ]
    config = Config(seed=seed, schedule={"iterations": iterations})
    facts = {"iterations": iterations, "gaussian_count": 1000 + seed, "train_seconds": 8.0 + seed}
    facts |= {"scene_name": "room_1", "data": {"path": "embedded"}, "render": None}
    return SimpleNamespace(path=path, config=config, metrics=lambda: lines, **facts)


def test_runs_that_differ_by_their_seed_share_a_row(tmp_path):
    runs = [
        trained(tmp_path / "a", ldr=(20, 25.0)),
        trained(tmp_path / "long", iterations=200),
        trained(tmp_path / "b", seed=1, ldr=(20, 27.0)),
    ]
    rows = compare_runs(runs)
    assert [(row.label, row.count) for row in rows] == [("a and 1 more", 2), ("long", 1)]
    assert rows[0].mean("psnr_ldr") == 26 and rows[0].deviation("psnr_ldr") == pytest.approx(2**0.5)
    assert rows[1].deviation("psnr_ldr") is None
    table = comparison_table(rows)
    assert "26.00 ± 1.41" in table and "30.00" in table and "100 ±" not in table and len(table.splitlines()) == 3
    csv_rows = list(csv.DictReader(comparison_csv(rows).splitlines()))
    assert csv_rows[0]["runs"] == "2" and float(csv_rows[0]["psnr_ldr_sd"]) == pytest.approx(2**0.5)
    assert csv_rows[1]["psnr_ldr_sd"] == ""
    latex = comparison_latex(rows)
    assert r"26.00 $\pm$ 1.41" in latex and r"room\_1" in latex and latex.count(r"\\") == 3


def test_names_are_no_formulas_of_a_spreadsheet(tmp_path):
    for name, cell in (("=cmd|' C calc'!A0", "'=cmd|' C calc'!A0"), ("@SUM(1)", "'@SUM(1)"), ("a", "a")):
        (row,) = csv.DictReader(comparison_csv(compare_runs([trained(tmp_path / name)])).splitlines())
        assert row["run"] == cell


def test_runs_that_have_not_ended_are_marked(tmp_path):
    stopped, whole = trained(tmp_path / "a"), trained(tmp_path / "b", seed=1)
    stopped.iterations = 60
    assert compare_runs([stopped])[0].label == "a (unfinished)"
    assert compare_runs([stopped, whole])[0].label == "a and 1 more (1 unfinished)"


def test_what_cannot_be_compared_is_one_line(tmp_path):
    one = trained(tmp_path / "a")
    empty = trained(tmp_path / "b", ldr=(), mu=())
    for runs, words in (([], "no runs"), ([one, one], "named twice"), ([one, empty], "b: has no evaluations")):
        with pytest.raises(SehdrError, match=words):
            compare_runs(runs)
    assert compare_runs([trained(tmp_path / "c", mu=(None, None))])[0].mean("psnr_mu") is None
