"""Full disks, read-only places and signals through the command line: nothing half-written, nothing lost."""

import shutil
import signal
import subprocess
import sys
import time

import pytest

from tests.make_scenes import edited_json

from ..full_disk import full_disk
from ..refusals import call, refused
from .damage import resign, snapshot

LITTLE = ("--max-size", "40", "--response", "hdr-nerf", "--model.initial-density", "0")


@pytest.mark.parametrize(
    "command", [("render",), ("render", "--evs=-2,0,2", "--multipart"), ("export",), ("report",)], ids=" ".join
)
def test_full_disk(embedded_run, tmp_path, capfd, command, coarse_figures):
    out = tmp_path / "out"
    out = out.with_suffix(".ply") if command[0] == "export" else out
    before = tmp_path / "before" / out.name
    assert call(command[0], embedded_run, "--out", before, "--device", "cpu", *command[1:]) == 0, (
        "kernels are compiled now"
    )
    shutil.rmtree(before.parent)
    with full_disk():
        line = refused(capfd, command[0], embedded_run, "--out", out, "--device", "cpu", *command[1:])
    assert "cannot be written" in line and ".tmp" not in line and list(tmp_path.iterdir()) == []


def test_full_disk_while_training_keeps_the_last_checkpoint(embedded_run, tmp_path, capfd):
    out = tmp_path / "run"
    shutil.copytree(embedded_run, out)
    with edited_json(out / "config.json") as values:
        values["schedule"]["iterations"] = 34
    resign(out, lambda tensors: None)
    before = snapshot(out / "checkpoints")
    flags = ("--device", "cpu", "--resume")
    with full_disk():
        line = refused(capfd, "train", "embedded", "--out", out, *flags)
    assert "cannot be written" in line and snapshot(out / "checkpoints") == before
    assert call("train", "embedded", "--out", out, *flags) == 0, "and goes on once there is room"


def test_read_only_place(embedded_run, tmp_path, capfd, coarse_figures):
    """/proc takes no new files, not even root's."""
    for command in ("render", "export", "report"):
        line = refused(capfd, command, embedded_run, "--out", "/proc/sehdr/out.ply")
        assert "/proc/sehdr" in line
    assert "/proc/sehdr" in refused(capfd, "train", "embedded", "--out", "/proc/sehdr", *LITTLE)


def start(*arguments) -> subprocess.Popen:
    # Tests that run in a shell's background have SIGINT ignored, and children inherit that.
    code = "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += "runpy.run_module('sehdr_warp', run_name='__main__')"
    command = [sys.executable, "-c", code, *(str(argument) for argument in arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)


def until(condition, seconds=60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def wait_for(process: subprocess.Popen, words: str) -> None:
    for line in process.stderr:
        if words in line:
            return
    raise AssertionError(f"{words!r} was never said; status {process.wait()}")


def test_interrupted_render_leaves_nothing(embedded_run, tmp_path):
    process = start(
        "render", embedded_run, "--out", tmp_path / "out", "--cameras", "orbit", "--count", "2000", "--evs=-2,0"
    )
    until(lambda: any(tmp_path.rglob("*.exr")))  # In a folder with a hidden name.
    process.send_signal(signal.SIGINT)
    assert "Traceback" not in process.communicate(timeout=60)[1] and process.returncode == 130
    assert list(tmp_path.iterdir()) == []


def test_interrupted_training_can_be_used(tmp_path, capfd):
    out = tmp_path / "run"
    process = start("train", "embedded", "--out", out, "--iterations", "100000", "--device", "cpu", *LITTLE)
    wait_for(process, "iteration 1/")
    process.send_signal(signal.SIGINT)
    rest = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and "--resume" in rest and "Traceback" not in rest
    assert call("render", out, "--out", tmp_path / "views", "--device", "cpu") == 0
