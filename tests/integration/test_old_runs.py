"""Folders of runs that earlier versions wrote, which are stored in tests/data."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.scene.images.hdr_files import read_hdr

from ..refusals import call, refused

DATA = Path(__file__).resolve().parents[1] / "data"


@pytest.mark.parametrize("command", ["render {run} --out {out}", "eval {run}", "train --resume --out {run}"])
def test_a_run_of_version_0_2_is_refused_with_what_to_do(command, tmp_path, capfd):
    words = command.format(run=DATA / "run-0.2", out=tmp_path / "views").split()
    line = refused(capfd, *words, "--device", "cpu")
    assert "of sehdr-warp 0.2.0" in line and "train again" in line
    assert not (tmp_path / "views").exists()


def test_a_run_of_version_0_3_renders_exports_and_resumes(tmp_path):
    """Refuse this run like that of 0.2 if the format of runs changes on purpose, and store one of the new format."""
    run = shutil.copytree(DATA / "run-0.3", tmp_path / "run")
    assert call("render", run, "--out", tmp_path / "views", "--device", "cpu", "-q") == 0
    pictures = [read_hdr(path) for path in (tmp_path / "views" / "hdr").glob("*.exr")]
    assert pictures and all(np.isfinite(picture).all() and picture.max() > 0 for picture in pictures)
    assert call("export", run, "--out", tmp_path / "scene.ply", "--device", "cpu", "-q") == 0
    assert call("train", "--resume", "--out", run, "--iterations", 24, "--device", "cpu", "-q") == 0
    assert (run / "checkpoints" / "iteration_00000024").is_dir()


FIELDS = [
    *("loss.clipped_lift", "mcmc.prune_near_points", "mcmc.prune_near_angle", "densification.prune_angle"),
    "model.background",
]


@pytest.mark.parametrize("field", FIELDS)
def test_a_run_trained_by_a_field_that_is_gone_is_read_with_one_warning(tmp_path, caplog, field):
    """Its config.json cannot be edited, because the checkpoint states the hash of that file."""
    run = shutil.copytree(DATA / "run-0.3", tmp_path / "run")
    config, file, (table, name) = RunFolder(run).read_config(), run / "config.json", field.split(".")
    values = json.loads(file.read_text())
    values[table][name] = 0.5
    file.write_text(json.dumps(values))
    assert RunFolder(run).read_config() == RunFolder(run).read_config() == config
    (warning,) = caplog.messages
    assert warning.startswith(f"{file}: {field} = 0.5 is of an earlier version and was removed")
