"""A folder of pictures scored against a set's truth."""

import json

import numpy as np
import pytest

import sehdr_warp as sw
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.evaluation.compare import eval_table
from sehdr_warp.evaluation.evaluate import evaluate
from sehdr_warp.output.images.exr import write_exr

from ..refusals import call
from .test_evaluate import VIEWS, radiance, run, scene, view


def write_pictures(folder, factors):
    folder.mkdir()
    for index, factor in factors.items():
        channels = dict(zip("RGB", np.moveaxis(radiance(index) * np.float32(factor), 2, 0), strict=True))
        write_exr(folder / f"r_{index}.exr", channels, pixel="float")
    return folder


def test_a_folder_scores_as_a_run_that_renders_it(tmp_path):
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
    assert "fitted on pixels that the scored views" in eval_table(result)


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
