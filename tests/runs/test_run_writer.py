"""Writers of a run: locks, replacements that were interrupted, and what is refused before the training."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.model.confidence import Evidence
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.runs.run_writer import RunWriter, write_confidence
from tests.fuzz.run_readers import SUMMARY, make_run
from tests.trial.harness import files_in

from .conftest import read_all, state


@pytest.mark.parametrize("name", [".new", ".ready"])
@pytest.mark.parametrize("place", ["itself", "inside"])
def test_links_in_place_of_an_interrupted_write_move_nothing(run, name, place):
    precious = run.parent / "precious"
    (precious / "checkpoints").mkdir(parents=True)
    (precious / "thesis.txt").write_text("mine")
    link = run / name if place == "itself" else run / name / "checkpoints"
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(precious if place == "itself" else precious / "checkpoints")
    before = files_in(run.parent)
    for act in (
        lambda: read_all(run),
        lambda: RunWriter(run).check_start(resume=True, overwrite=False),
        lambda: RunWriter(run).lock(),
    ):
        with pytest.raises(InputError, match="is a link"):
            act()
    assert files_in(run.parent) == before


def test_only_a_training_finishes_an_interrupted_write(run):
    """A new run, complete beside the one that it replaces: reading leaves both alone, a training takes the new one."""
    other = run.parent / "other"
    make_run(other)
    (other / ".lock").unlink()
    for name in ("summary.json", "metrics.jsonl"):
        (other / name).unlink()
    shutil.move(other, run / ".new")
    before = files_in(run)
    assert read_all(run)[1] == SUMMARY and files_in(run) == before
    assert RunWriter(run).check_start(resume=True, overwrite=False)
    assert not (run / ".new").exists() and RunFolder(run).read_summary() == {}
    load_run(run)


def test_another_programs_folder_of_that_name_is_left_alone(tmp_path):
    (tmp_path / ".new").mkdir()
    (tmp_path / ".new" / "thesis.txt").write_text("mine")
    before = files_in(tmp_path)
    for how in ({"resume": True, "overwrite": False}, {"resume": False, "overwrite": True}):
        with pytest.raises(InputError, match=r"thesis\.txt: lies in the folder of a new run"):
            RunWriter(tmp_path).check_start(**how)
    assert {name: text for name, text in files_in(tmp_path).items() if name != ".lock"} == before


def test_a_lock_that_was_removed_stops_the_writer(run):
    writer = RunWriter(run)
    writer.lock()
    writer.append_metrics({"iteration": 3})
    (run / ".lock").unlink()
    other = RunWriter(run)
    other.lock()
    for write in (
        lambda: writer.append_metrics({"iteration": 4}),
        lambda: writer.write_summary({}),
        lambda: writer.write_checkpoint({"a": torch.zeros(1)}, {"iteration": 1}, keep=1),
        lambda: writer.rewind_metrics(0),
    ):
        with pytest.raises(SehdrError, match=r"\.lock: was removed"):
            write()
    other.unlock()
    writer.unlock()


def test_resume_begins_where_nothing_was_begun(tmp_path):
    for folder in (tmp_path, tmp_path / "missing"):
        assert not RunWriter(folder).check_start(resume=True, overwrite=False)


def test_confidence_is_the_same_file_each_time(run):

    evidence, folder = Evidence(*torch.rand(5, 4)), RunFolder(run)
    contents = set()
    for _ in range(8):
        write_confidence(folder, evidence, "a" * 64)
        contents.add(folder.confidence.read_bytes())
    assert len(contents) == 1


def test_a_place_that_cannot_be_written_is_refused_before_the_photos_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(InputError, match=f"cannot be written, because {tmp_path} is read-only"):
        RunWriter(tmp_path / "runs" / "first").check_start(resume=False, overwrite=False)
    assert not list(tmp_path.iterdir())


def test_only_the_newest_are_kept(folder):
    for iteration in (9, 10, 100):
        folder.write_checkpoint(*state(iteration), keep=2)
    assert sorted(p.name for p in folder.checkpoints.iterdir()) == ["iteration_00000010", "iteration_00000100"]
    assert folder.newest_checkpoint().values["iteration"] == 100
    folder.write_checkpoint(*state(50), keep=2)  # As by a training that goes on before a damaged one
    assert sorted(p.name for p in folder.checkpoints.iterdir()) == ["iteration_00000010", "iteration_00000050"]


def test_what_a_killed_writer_left_is_no_checkpoint(folder):
    """Nor is what somebody else keeps there; that stays."""
    program = "import os, sys; from pathlib import Path; from sehdr_warp.files import atomic_folder\n"
    program += "with atomic_folder(Path(sys.argv[1])) as half: (half / 'half').touch(); os._exit(9)"
    subprocess.run([sys.executable, "-c", program, folder.checkpoints / "iteration_00000005"], check=False)
    [left] = folder.checkpoints.iterdir()
    theirs = [folder.checkpoints / name for name in ("iteration_best", "iteration_00000001", ".iteration_x")]
    for place in theirs:
        place.mkdir()
        (place / "half").write_bytes(b"half")
    with pytest.raises(InputError, match="iteration_00000001"):
        folder.newest_checkpoint()
    folder.write_checkpoint(*state(6), keep=1)
    assert not left.exists() and all((place / "half").exists() for place in theirs)
