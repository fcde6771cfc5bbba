"""A run that somebody sent: reading it changes nothing, follows no link, and refuses in one line what does not fit."""

import os
import shutil

import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.runs.run_writer import RunWriter
from tests.fuzz.run_readers import PLAN, SUMMARY
from tests.trial.harness import files_in

from .conftest import read_all


def test_reading_changes_nothing(run):
    before = files_in(run)
    metrics, summary, decisions, clipped = read_all(run)
    assert summary == SUMMARY and decisions == PLAN["decisions"] and len(metrics) == 1 and len(clipped) == 4
    assert files_in(run) == before


FILES = ["config.json", "scene.json", "run.json", "plan.json", "summary.json", "metrics.jsonl"]


FILES += ["confidence.safetensors", "checkpoints", "checkpoints/iteration_00000000", ".lock", "tensorboard"]


FILES += ["checkpoints/iteration_00000000/state.safetensors", "checkpoints/iteration_00000000/checkpoint.json"]


@pytest.mark.parametrize("name", FILES)
def test_a_link_is_refused_even_to_a_sound_file(run, name):
    moved = run.parent / "elsewhere"
    if (run / name).exists():
        (run / name).rename(moved)
    else:
        moved.mkdir()
    (run / name).symlink_to(moved)
    before = files_in(run.parent)
    with pytest.raises(InputError, match="is a link"):
        read_all(run)
    for how in ({"resume": True, "overwrite": False}, {"resume": False, "overwrite": True}):
        with pytest.raises(InputError, match="is a link"):
            RunWriter(run).check_start(**how)
    assert files_in(run.parent) == before


def test_a_folder_of_runs_is_told_from_a_run_by_naming_the_newest(run):
    older = run.parent / "older"
    shutil.copytree(run, older)
    os.utime(older / "config.json", (1, 1))
    (run.parent / "notes.txt").touch()
    with pytest.raises(InputError, match=rf"is not a run \(no config.json\); did you mean {run}\?"):
        load_run(run.parent)
    (run / "run.json").unlink()
    with pytest.raises(InputError, match=rf"did you mean {older}\?"):
        load_run(run.parent)


def test_a_run_whose_replacement_was_interrupted_says_so(run):
    (run / ".new").mkdir()
    (run / "run.json").unlink()
    with pytest.raises(InputError, match="being replaced.*--resume"):
        load_run(run)


def test_a_sparse_checkpoint_is_refused_by_its_length(run):
    """Reading 40 GiB for its hash would take a minute."""
    os.truncate(next(run.glob("checkpoints/*/state.safetensors")), 40 << 30)
    with pytest.raises(InputError, match="is not safetensors"):
        load_run(run)


def test_files_that_may_not_be_read_say_so(run, monkeypatch):
    """The system's answer is simulated, because root reads everything."""
    folder = RunFolder(run)
    listdir = os.listdir

    def refuse(path):
        if str(path).endswith("checkpoints"):
            raise PermissionError(13, "Permission denied", str(path))
        return listdir(path)

    monkeypatch.setattr(os, "listdir", refuse)
    with pytest.raises(InputError, match=r"checkpoints: cannot be read \(Permission denied\); check its permissions"):
        folder.newest_checkpoint()
