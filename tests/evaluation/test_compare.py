"""Runs side by side, and folders of pictures against truth."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest

import sehdr_warp as sw
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.evaluation.compare import compare_runs, comparison_csv, comparison_latex, comparison_table, eval_table
from sehdr_warp.evaluation.evaluate import evaluate
from sehdr_warp.output.images.exr import write_exr
from sehdr_warp.runs.config import Config

from ..refusals import call
from .test_evaluate import VIEWS, radiance, run, scene, view


def trained(path, *, seed=0, iterations=100, ldr=(20.0, 25.0), mu=(None, 30.0)):
    lines = [
        {"iteration": 50 * i, "seconds": 4.0 * i, "psnr_ldr": a, "psnr_mu": b}
        for i, (a, b) in enumerate(zip(ldr, mu, strict=True), 1)
    ]
    config = Config(seed=seed, schedule={"iterations": iterations})
    facts = {"iterations": iterations, "gaussian_count": 1000 + seed, "train_seconds": 8.0 + seed}
    return SimpleNamespace(
        path=path, config=config, metrics=lambda: lines, scene_name="room_1", data={"path": "embedded"}, **facts
    )


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


def write_pictures(folder, factors):
    folder.mkdir()
    for index, factor in factors.items():
        channels = dict(zip("RGB", np.moveaxis(radiance(index) * np.float32(factor), 2, 0), strict=True))
        write_exr(folder / f"r_{index}.exr", channels, pixel="float")
    return folder


def test_a_folder_scores_as_a_run_that_renders_it(tmp_path, logged):
    folder = write_pictures(tmp_path / "out", dict.fromkeys(range(4), 0.5))
    ours, theirs = sw.evaluate_folder(folder, scene(VIEWS)), evaluate(run(lambda hdr: hdr * 0.5), scene(VIEWS))
    for name, figures in theirs["protocol"].items():
        assert ours["protocol"][name] == pytest.approx(figures, nan_ok=True)
    assert ours["pu21"] == theirs["pu21"] and ours["scale_from"] == "train"
    assert ours["protocol"]["aligned"]["scale"] == pytest.approx(2.0)
    assert ours["ldr"]["psnr"] is None and "no simulated photos" in ours["ldr"]["reason"]
    assert ours["missing"] == ours["extra"] == []
    json.dumps(ours, allow_nan=False)
    table = eval_table(ours)
    assert str(folder) in table and "LDR" not in table


def test_pictures_without_truth_are_no_run(tmp_path, capsys):
    folder = write_pictures(tmp_path / "out", {2: 1.0})
    assert call("eval", folder) == 2
    assert "out: holds EXR pictures; add --truth" in capsys.readouterr().err
    (folder / "run.json").touch()  # A run in which somebody keeps a map
    assert call("eval", folder) == 1
    assert "out: is not a run (no config.json)" in capsys.readouterr().err


def test_missing_and_extra_files_are_said(tmp_path, logged):
    folder = write_pictures(tmp_path / "out", {3: 1.0, 9: 1.0})
    result = sw.evaluate_folder(folder, scene(VIEWS))
    assert (result["missing"], result["extra"], result["scale_from"]) == (["r_2"], ["r_9"], "scored")
    assert [row["name"] for row in result["views"]] == ["r_3"]
    assert any("1 views have no file: r_2" in line for line in logged)
    assert any("files belong to no view: r_9" in line for line in logged)
    assert "fitted on what the scored views" in eval_table(result)


def test_folders_that_cannot_be_scored(tmp_path):
    folder = write_pictures(tmp_path / "out", {7: 1.0})
    bare = scene([view(0, "train", truth=False), view(1, "test", truth=False)])
    for place, truth, words in (
        (folder, scene(VIEWS), "holds no r_2.exr"),
        (tmp_path / "none", scene(VIEWS), "is not a folder"),
        (folder, bare, "no HDR truth"),
    ):
        with pytest.raises(InputError, match=words):
            sw.evaluate_folder(place, truth)
    small = write_pictures(tmp_path / "small", {2: 1.0})
    write_exr(small / "r_2.exr", dict.fromkeys("RGB", np.ones((4, 5))), overwrite=True)
    with pytest.raises(SehdrError, match="its picture is 5 x 4.*: max_size reduces the truth"):
        sw.evaluate_folder(small, scene(VIEWS))
