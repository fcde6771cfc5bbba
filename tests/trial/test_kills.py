"""SIGKILL at any moment: what was whole stays whole, what was begun can be finished, to the same bits."""

import json
import os
import random
import shutil
from pathlib import Path

import pytest
import torch

from sehdr_warp.output.images.display import encode_srgb
from sehdr_warp.own_files import LIST, first_unlisted
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.scene import Camera, look_at
from tests.scene.panorama_room import light, walls
from tests.scene.video.clips import write_clip

from .harness import COMMANDS, SEED, TRAIN, VIEW, browse, call, files_in

pytestmark = pytest.mark.trial
KILLS, KILLS_EACH, KILLS_OF_VIDEO = 50, 20, 8
ANEW = [word if word != "run" else "new" for word in TRAIN] + ["-q"]


def result(run: Path):
    """What a training made, without its times."""
    folder = RunFolder(run)
    checkpoint = folder.newest_checkpoint()
    metrics = [{name: value for name, value in line.items() if name != "seconds"} for line in folder.read_metrics()]
    values = {name: checkpoint.values[name] for name in ("iteration", "order", "skipped_steps", "run")}
    return checkpoint.tensors, values, metrics


def left_over(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob(".*") if path.name not in (LIST, ".lock")]


def finish(space: Path) -> None:
    """Goes on with the training in `new`, or begins it where nothing was; it must end as that in `run` did."""
    out = space / "new"
    ended = call("train", "--resume", "--out", "new", "--device", "cpu", "-q", folder=space)
    if ended.code:
        assert not out.exists() or not list(out.glob("[!.]*")), ended.err
        assert call(*ANEW, folder=space).code == 0
    for (tensors, *result_values), (expected, *expected_values) in [(result(out), result(space / "run"))]:
        assert result_values == expected_values and tensors.keys() == expected.keys()
        assert all(torch.equal(tensors[name], expected[name]) for name in expected)
    assert left_over(space) == []


@pytest.mark.parametrize("number", range(KILLS))
def test_training_killed_at_random(space, number):
    took = 1.3 * json.loads((space / "run" / "took.json").read_text())
    call(*ANEW, folder=space, kill_after=random.Random(SEED * 1000 + number).uniform(0, took))
    finish(space)


@pytest.mark.parametrize("number", range(KILLS))
def test_training_killed_at_a_change_of_the_disk(space, number):
    """Kill a new run, or one that replaces another, beside a file of the user's."""
    kind, words = ("train anew", ANEW) if number % 2 else ("train", [*ANEW, "--overwrite"])
    changes = json.loads((space / "run" / "changes.json").read_text())[kind]
    if number % 2 == 0:
        shutil.copytree(space / "run", space / "new")
        (space / "new" / "notes.txt").write_text("mine")
    photos = files_in(space / "photos")
    assert call(*words, folder=space, kill_at=1 + number * changes // KILLS).code == -9
    finish(space)
    assert files_in(space / "photos") == photos
    assert number % 2 or (space / "new" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("number", range(KILLS_EACH))
def test_viewer_killed(space, number):
    """At a change of the disk or at random, while it is asked for all that it serves; the next one serves."""
    changes = json.loads((space / "run" / "changes.json").read_text())["view"]
    kill = {"kill_at": 1 + number * changes // KILLS_EACH}
    if number % 2:
        kill = {"kill_after": random.Random(SEED * 1000 + number).uniform(0, 2)}
    before = files_in(space)
    assert call(*VIEW, folder=space, prepare=browse(space, ever=True), **kill).code == -9
    shutil.rmtree(space / "tmp", ignore_errors=True)
    assert files_in(space) == before
    assert call(*VIEW, folder=space, prepare=browse(space, ever=False)).code == 0
    assert int((space / "tmp" / "asked").read_text()) > 1000


@pytest.mark.parametrize("number", range(KILLS_EACH))
@pytest.mark.parametrize("name", COMMANDS)
def test_commands_killed_at_a_change_of_the_disk(space, name, number):
    """What is replaced is whole, before or after; what a user keeps beside it stays; the next call ends the work."""
    changes = json.loads((space / "run" / "changes.json").read_text())[name]
    words = COMMANDS[name] + (["--seeds", "0,1"] if name == "quality" else [])
    stored = {path: path.read_bytes() for path in space.rglob("result.json")}
    (space / "made" / "notes.txt").write_text("mine")
    run = shutil.copytree(space / "run", space / "copy")
    assert call(*words, folder=space, kill_at=1 + number * changes // KILLS_EACH).code in (0, -9)
    for path in (*(space / "made").glob("[!.]*"), space / "set"):
        theirs = first_unlisted(path) if path.exists() else None
        assert theirs is None or theirs.name == "notes.txt" or path.name == "jobs", f"{theirs} is not whole"
    assert call(*words, folder=space).code == 0
    assert (space / "made" / "notes.txt").read_text() == "mine"
    assert {path: path.read_bytes() for path in stored} == stored, "finished jobs were run again"
    assert left_over(space) == []
    assert sorted(path.name for path in run.rglob("*")) == sorted(path.name for path in (space / "run").rglob("*"))


VIDEO = ["train", "clip.mov", "--preset", "demo", "--iterations", "12", "--max-size", "32", "--seed", "3"]
VIDEO += ["--out", "new", "--device", "cpu", "-q"]


@pytest.fixture(scope="session")
def filmed(tmp_path_factory) -> Path:
    """A clip of a room, the run that is trained on it, the cache of frames and cameras, and how much changes."""
    pytest.importorskip("av")
    pytest.importorskip("pycolmap")
    folder, painted, frames = tmp_path_factory.mktemp("trial") / "space", walls(), []
    folder.mkdir()
    for i in range(30):
        camera = Camera(256, 192, 200, 200, 128, 96, look_at((-0.6 + 0.04 * i, -0.5, 0.1), (0.1, 1, 0)))
        frames.append(encode_srgb(0.5 * light(camera, painted)))
    write_clip(folder / "clip.mov", frames, codec="libx264", pixels="yuv420p")
    ended = call(*VIDEO, folder=folder, prepare=lambda: os.environ.update(SEHDR_CACHE="cache"))
    assert ended.code == 0, ended.err
    (folder / "new").rename(folder / "run")
    (folder / "changes.json").write_text(json.dumps(ended.changes))
    return folder


@pytest.mark.parametrize("number", range(KILLS_OF_VIDEO))
def test_training_on_a_video_killed_at_a_change_of_the_disk(filmed, tmp_path, number):
    """Frames are the same files again, and so is the run, unless COLMAP had to find the cameras anew: its threads add
    in an order of their own."""
    space = shutil.copytree(filmed, tmp_path / "space")
    changes, cache = json.loads((space / "changes.json").read_text()), files_in(space / "cache")
    if number % 3:  # Of these the cameras are known already.
        for folder in (space / "cache").glob("video-*"):
            shutil.rmtree(folder)
    else:
        shutil.rmtree(space / "cache")
    prepare = lambda: os.environ.update(SEHDR_CACHE="cache")  # noqa: E731
    ended = call(*VIDEO, folder=space, prepare=prepare, kill_at=1 + number * changes // KILLS_OF_VIDEO)
    assert ended.code in (0, -9)
    if (
        not (space / "new" / "run.json").exists()
        or call(*["train", "--resume", "--out", "new", "--device", "cpu", "-q"], folder=space, prepare=prepare).code
    ):
        assert not list((space / "new").glob("[!.]*"))
        assert call(*VIDEO, folder=space, prepare=prepare).code == 0
    files, known = files_in(space / "cache"), number % 3 > 0
    cache = {name: data for name, data in cache.items() if known or name.startswith("video-")}
    assert {name: files.get(name) for name in cache} == cache
    assert left_over(space / "new") == [] and (space / "new" / "summary.json").exists()
    for (tensors, *result_values), (expected, *expected_values) in [(result(space / "new"), result(space / "run"))]:
        assert not known or (
            result_values == expected_values and all(torch.equal(tensors[name], expected[name]) for name in expected)
        )
