"""Damaged runs, cameras and flags through the command line: one clear line, and nothing changed."""

import shutil

import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.runs.run_writer import RunWriter

from ..refusals import call, refused
from .damage import checkpoint_of, edit_json, edit_view, flip_byte, remove_value, resign, shorten_means, snapshot


@pytest.fixture
def run(embedded_run, tmp_path):
    """A copy to damage."""
    shutil.copytree(embedded_run, tmp_path / "run")
    return tmp_path / "run"


HASH = "state.safetensors: its SHA-256"
CHANGED = "scene.json: was changed since its checkpoint was written; put it back as it was, or train again"
RUNS = {
    "flipped byte": (lambda run: flip_byte(checkpoint_of(run) / "state.safetensors"), HASH),
    "no tensors": (
        lambda run: (checkpoint_of(run) / "state.safetensors").unlink(),
        "state.safetensors: file not found",
    ),
    "no values": (
        lambda run: (checkpoint_of(run) / "checkpoint.json").unlink(),
        "checkpoint.json: file not found; remove this folder to use an older checkpoint, or train again",
    ),
    "other format": (
        lambda run: edit_json(checkpoint_of(run) / "checkpoint.json", format=9),
        "checkpoint.json: format = 9 is of another version, and this one reads format",
    ),
    "values without iteration": (
        lambda run: remove_value(checkpoint_of(run) / "checkpoint.json", "iteration"),
        "checkpoint.json: iteration is missing",
    ),
    "no checkpoint": (
        lambda run: shutil.rmtree(run / "checkpoints"),
        "checkpoints: holds no complete checkpoint; train again, with --overwrite",
    ),
    "tensor missing": (
        lambda run: resign(run, lambda tensors: tensors.pop("gaussians.means")),
        "its tensors do not fit the config ('gaussians.means'); the run is damaged: train again",
    ),
    "tensor of other shape": (lambda run: resign(run, shorten_means), "its tensors do not fit the config ("),
    "no config": (lambda run: (run / "config.json").unlink(), "is not a run (no config.json)"),
    "config unknown key": (
        lambda run: edit_json(run / "config.json", speed=3),
        "config.json: unknown field speed = 3, did you mean seed?",
    ),
    "run.json without response": (
        lambda run: edit_json(run / "run.json", response=None),
        "run.json: response = None: input should be a valid dictionary",
    ),
    "response damaged": (
        lambda run: edit_json(run / "run.json", response={"kind": "table"}),
        "run.json: response: the stored table curve is damaged",
    ),
    "base exposure zero": (
        lambda run: edit_json(run / "run.json", base_time=0),
        "run.json: base_time = 0: input should be greater",
    ),
    "scene.json gone": (lambda run: (run / "scene.json").unlink(), CHANGED),
    "camera NaN": (
        lambda run: edit_view(run, fx=float("nan")),
        "scene.json: a view is damaged (camera fx, fy, cx, cy = [nan,",
    ),
    "camera huge": (
        lambda run: edit_view(run, width=10**9, height=10**9),
        "scene.json: a view is damaged (image size 1000000000 x 1000000000",
    ),
    "exposure zero": (
        lambda run: edit_view(run, exposure_time=0),
        "scene.json: views.exposure_time = 0: input should be greater than 0",
    ),
}


@pytest.mark.parametrize("case", RUNS)
def test_damaged_runs(run, tmp_path, capfd, case):
    change, words = RUNS[case]
    change(run)
    before = snapshot(run)
    commands = [
        ("render", run, "--out", tmp_path / "out", "--device", "cpu"),
        ("eval", run, "--device", "cpu", "--json", tmp_path / "figures.json"),
        ("export", run, "--out", tmp_path / "scene.ply"),
        ("train", "embedded", "--out", run, "--device", "cpu", "--resume"),
    ]
    for arguments in commands if case == "flipped byte" else commands[:1]:  # All read runs by one function.
        line = refused(capfd, *arguments)
        assert words in line and str(run) in line, arguments
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"] and snapshot(run) == before


def test_a_folder_of_other_things_is_no_run(tmp_path, capfd):
    (tmp_path / "dog.ply").write_bytes(b"ply")
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "mother.txt").write_text("dear")
    (tmp_path / "other" / "checkpoints").mkdir(parents=True)
    (tmp_path / "other" / "config.json").write_text("{}")
    (tmp_path / "other" / "checkpoints" / "weights.bin").write_text("theirs")
    before = snapshot(tmp_path)
    for flag in ((), ("--overwrite",), ("--resume",)):
        for name in ("letters", "other"):
            assert name in refused(capfd, "train", "embedded", "--out", tmp_path / name, "--device", "cpu", *flag)
    assert "no such file or folder" in refused(capfd, "render", tmp_path / "gone", "--out", tmp_path / "out")
    assert "dog.ply: is a file, not a run; give the folder" in refused(capfd, "eval", tmp_path / "dog.ply")
    assert snapshot(tmp_path) == before


def test_moved_photos(run, tmp_path, capfd):
    edit_json(run / "run.json", data={"path": str(tmp_path / "photos"), "exposure_index": None, "max_size": None})
    for arguments in (("eval", run), ("report", run, "--out", tmp_path / "report")):
        assert "--data" in refused(capfd, *arguments, "--device", "cpu")
    assert call("render", run, "--out", tmp_path / "out", "--device", "cpu", "--cameras", "train") == 0


def test_nothing_is_replaced(embedded_run, tmp_path, capfd):
    out = tmp_path / "out"
    arguments = ("render", embedded_run, "--out", out, "--device", "cpu", "--evs=-2,0")
    assert call(*arguments) == 0
    (out / "notes.txt").write_text("mine")
    before = snapshot(out)
    assert "--overwrite" in refused(capfd, *arguments)
    assert snapshot(out) == before
    assert call(*arguments, "--overwrite") == 0 and (out / "notes.txt").read_text() == "mine"
    for place in ("hdr/truth.exr", "preview/holiday.png"):
        (out / place).write_text("mine")
        assert place in refused(capfd, *arguments, "--overwrite")
        assert (out / place).read_text() == "mine"
        (out / place).unlink()
    (tmp_path / "scene.ply").write_text("mine")
    assert "--overwrite" in refused(capfd, "export", embedded_run, "--out", tmp_path / "scene.ply")
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "stops.png").write_text("mine")
    assert "--overwrite" in refused(capfd, "report", embedded_run, "--out", tmp_path / "report", "--device", "cpu")
    assert (tmp_path / "scene.ply").read_text() == (tmp_path / "report" / "stops.png").read_text() == "mine"
    (tmp_path / "a.ply").mkdir()
    assert "is a file" in refused(capfd, "render", embedded_run, "--out", tmp_path / "scene.ply", "--device", "cpu")
    assert "is a folder" in refused(capfd, "export", embedded_run, "--out", tmp_path / "a.ply")
    several = ("--kind", "ldr", "--exposure", "1/60,1/125")
    assert call("export", embedded_run, "--out", tmp_path / "b.ply", *several, "-q") == 2
    assert "one exposure; name one" in capfd.readouterr().err
    assert "no photo has a mask" in refused(capfd, "export", embedded_run, "--out", tmp_path / "b.ply", "--mask-only")
    assert call("export", embedded_run, "--out", tmp_path / "b.ply", "--data", tmp_path, "-q") == 2
    assert "only read for --mask-only" in capfd.readouterr().err


def test_a_folder_that_is_no_run_is_not_replaced_and_the_remedy_says_so(tmp_path):
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(InputError, match="is not a run .*; choose another folder for the run"):
        RunWriter(tmp_path).check_start(resume=False, overwrite=True)
    with pytest.raises(InputError, match="is not a run .*; give the folder that"):
        RunWriter(tmp_path).check_start(resume=True, overwrite=False)
