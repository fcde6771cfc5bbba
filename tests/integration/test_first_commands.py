"""The commands of a first session, one after another, on the embedded run."""

import json
import shutil

import numpy as np
import pytest

from sehdr_warp.response import response_by_name
from sehdr_warp.runs.open import enclosing_run_response
from sehdr_warp.scene.images.hdr_files import read_hdr
from sehdr_warp.scene.images.ldr_files import read_ldr

from ..refusals import call


@pytest.fixture
def run(embedded_run):
    return embedded_run


def test_training_leaves_a_run_that_says_how_it_was_made(run):
    config = json.loads((run / "config.json").read_text())
    assert (config["seed"], config["schedule"]["iterations"], config["response"]["name"]) == (3, 30, "hdr-nerf")
    assert json.loads((run / "run.json").read_text())["data"] == {
        "path": "embedded",
        "exposure_index": None,
        "max_size": 48,
        "holdout": None,
    }
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["iteration"] == 30 and {"seconds", "psnr_ldr", "psnr_mu", "gaussians", "split"} <= lines[-1].keys()


def test_render_writes_hdr_previews_and_brackets(run, tmp_path, capsys):
    out = tmp_path / "renders"
    assert call("render", run, "--out", out, "--evs=-2,0,2", "--device", "cpu", "--json") == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert files and all((tmp_path / name).exists() for name in files)
    views = sorted(path.stem for path in (out / "hdr").glob("*.exr"))
    assert views and views == sorted(path.stem for path in (out / "preview").glob("*.png"))
    assert len(json.loads((out / "brackets.json").read_text())["views"]) == len(views)
    assert call("render", run, "--out", out, "--device", "cpu") == 1, "nothing is replaced without --overwrite"


@pytest.mark.parametrize("kind, tolerance", [("png", 0.005), ("png16", 1e-4)])
def test_simulated_photos_merge_back_to_the_rendered_radiance(run, tmp_path, kind, tolerance, capsys):
    """Simulate photos of a run and merge them (Debevec and Malik 1997, Eq. 6): RMS error beside its HDR views."""
    out = tmp_path / "renders"
    evs = ",".join(str(ev) for ev in range(-8, 9, 2))
    flags = ("--device", "cpu", "--pixel", "float", "--ldr-brackets", kind)
    assert call("render", run, "--out", out, f"--evs={evs}", *flags) == 0
    manifest = json.loads((out / "brackets.json").read_text())
    decode = response_by_name(manifest["response"]).decode
    for view in manifest["views"]:
        total = weights = 0.0
        for exposure in view["exposures"]:
            photo = read_ldr(out / exposure["ldr_file"])
            value = photo.pixels / photo.levels
            weight = np.where((value > 0.02) & (value < 0.98), np.minimum(value, 1 - value), 0)
            total += weight * np.log(np.maximum(decode(value), 1e-12) / exposure["exposure_time"])
            weights += weight
        radiance = read_hdr(out / "hdr" / f"{view['view']}.exr")
        weighted = weights > 0
        assert weighted[radiance > 1e-3].mean() > 0.99
        error = np.exp(total[weighted] / weights[weighted]) / radiance[weighted] - 1
        assert np.sqrt(np.mean(error**2)) < tolerance


def test_eval_writes_json_and_prints_a_table(run, tmp_path, capsys):
    file = tmp_path / "figures.json"
    assert call("eval", run, "--json", file, "--device", "cpu") == 0
    result = json.loads(file.read_text())
    assert result["protocol"]["gt-max"]["psnr_mu"] > 10 and result["ldr"]["psnr"] > 10 and result["train_seconds"] > 0
    output = capsys.readouterr().out
    assert "gt-max" in output and output.endswith(f"\n{file}\n")
    assert call("eval", run, "--json", file, "--device", "cpu") == 1
    capsys.readouterr()
    assert call("eval", run, "--json", "-", "--device", "cpu") == 0
    assert json.loads(capsys.readouterr().out)["ldr"] == result["ldr"]


def test_compare_takes_a_folder_of_runs_and_names_its_files(run, tmp_path, capsys):
    for name in ("a", "b"):
        shutil.copytree(run, tmp_path / "runs" / name)
    (tmp_path / "runs" / "notes").mkdir()
    table = tmp_path / "table.csv"
    assert call("compare", tmp_path / "runs", "--csv", table) == 0
    output = capsys.readouterr().out
    assert "a and 1 more" in output and output.endswith(f"\n{table}\n")
    assert call("compare", tmp_path / "runs" / "notes") == 1
    assert "notes: is not a run" in capsys.readouterr().err
    (tmp_path / "runs" / "b" / "metrics.jsonl").unlink()  # As of a training that has just begun.
    assert call("compare", tmp_path / "runs") == 0
    result = capsys.readouterr()
    assert "a and 1 more" not in result.out and "runs/b: has no evaluations" in result.err
    assert call("compare", tmp_path / "runs" / "b") == 1
    assert "b: has no evaluations of held-out views; train it" in capsys.readouterr().err


def test_eval_of_pictures_divides_photos_into_the_regions_of_eval_of_the_run(run, tmp_path, capsys):
    """They are reduced through the run's response: the pictures lie in the run, or a training would choose it."""

    def shares(*words):
        assert call(*words, "--json", "-") == 0
        return {name: region["fraction"] for name, region in json.loads(capsys.readouterr().out)["regions"].items()}

    inside, outside = shutil.copytree(run, tmp_path / "run") / "views", tmp_path / "views"
    assert call("render", run, "--out", outside, "--device", "cpu") == 0
    shutil.copytree(outside, inside)
    capsys.readouterr()
    expected, options = shares("eval", run, "--device", "cpu"), ("--truth", "embedded", "--max-size", 48)
    assert expected == shares("eval", inside / "hdr", *options) == shares("eval", outside / "hdr", *options)
    assert expected != shares("eval", inside / "hdr", *options, "--response", "srgb")
    assert enclosing_run_response(outside / "hdr") is None
    assert getattr(enclosing_run_response(inside / "hdr"), "name", None) == "hdr-nerf"


def test_export_writes_files_that_render_and_convert(run, tmp_path, capsys):
    file, other = tmp_path / "scene.ply", tmp_path / "scene.glb"
    assert call("export", run, "--out", file, "--kind", "hdr", "--cameras", "--device", "cpu") == 0
    assert file.read_bytes().startswith(b"ply\n") and str(file) in capsys.readouterr().out
    assert call("convert", file, other, "--degree", 3, "--device", "cpu") == 0
    assert call("render", file, "--cameras", "train", "--out", tmp_path / "views", "--device", "cpu") == 0
    view = json.loads((run / "scene.json").read_text())["views"][0]
    (tmp_path / "mine.json").write_text(json.dumps({"cameras": [{"name": "a", **view["camera"]}]}))
    assert call("render", other, "--cameras", tmp_path / "mine.json", "--out", tmp_path / "b", "--device", "cpu") == 0
    assert call("convert", file, tmp_path / "scene.splat") == 1
    assert "holds 8 bits" in capsys.readouterr().err and not (tmp_path / "scene.splat").exists()


def test_report_writes_pictures(run, tmp_path, capsys, coarse_figures):
    assert call("report", run, "--out", tmp_path / "report", "--device", "cpu") == 0
    assert len(list((tmp_path / "report").iterdir())) >= 2
