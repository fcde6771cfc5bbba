"""Damaged runs, full disks and signals through the command line: one clear line, nothing half-written, nothing lost."""

import json
import shutil
import signal
import subprocess
import sys

import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.runs.run_writer import RunWriter

from ..full_disk import full_disk
from ..refusals import call, refused

# ------------------------------------------------------------------------------------------------------------- runs


LITTLE = ("--max-size", "40", "--response", "hdr-nerf", "--model.initial-density", "0")


@pytest.fixture
def trained(embedded_run):
    return embedded_run


@pytest.fixture
def run(trained, tmp_path):
    """A copy to damage."""
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


def snapshot(folder) -> dict:
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def checkpoint_of(run):
    return next((run / "checkpoints").iterdir())


def flip_byte(path, at: int = -5):
    content = bytearray(path.read_bytes())
    content[at] ^= 0x10
    path.write_bytes(content)


def edit_json(path, **fields):
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def edit_view(run, **fields):
    """Change the first view or its camera, and state the file's hash anew, so that the value itself is checked."""
    values = json.loads((run / "scene.json").read_text())
    for name, value in fields.items():
        (values["views"][0] if name in values["views"][0] else values["views"][0]["camera"])[name] = value
    (run / "scene.json").write_text(json.dumps(values))
    edit_json(checkpoint_of(run) / "checkpoint.json", run=RunFolder(run).hashes())


def resign(run, change):
    """Changes a checkpoint's tensors and states their hash anew."""
    import hashlib

    from safetensors.torch import load, save

    folder = checkpoint_of(run)
    tensors = load((folder / "state.safetensors").read_bytes())
    change(tensors)
    content = save(tensors)
    (folder / "state.safetensors").write_bytes(content)
    hashes = {"sha256": hashlib.sha256(content).hexdigest(), "run": RunFolder(run).hashes()}
    edit_json(folder / "checkpoint.json", **hashes)


def remove_value(path, name):
    path.write_text(json.dumps({key: value for key, value in json.loads(path.read_text()).items() if key != name}))


def cut_tensors(run):
    path = checkpoint_of(run) / "state.safetensors"
    path.write_bytes(path.read_bytes()[:-9])


def shorten_means(tensors):
    tensors["gaussians.means"] = tensors["gaussians.means"][:3].clone()


HASH = "state.safetensors: its SHA-256"
CHANGED = "scene.json: was changed since its checkpoint was written; put it back as it was, or train again"
RUNS = {
    "flipped byte": (lambda run: flip_byte(checkpoint_of(run) / "state.safetensors"), HASH),
    "truncated tensors": (cut_tensors, HASH),
    "pickle": (lambda run: (checkpoint_of(run) / "state.safetensors").write_bytes(b"\x80\x04."), HASH),
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
        "checkpoint.json: iteration = ",
    ),
    "no checkpoint": (
        lambda run: shutil.rmtree(run / "checkpoints"),
        "checkpoints: holds no complete checkpoint; train again, or continue with --resume",
    ),
    "tensor missing": (
        lambda run: resign(run, lambda tensors: tensors.pop("gaussians.means")),
        "its tensors do not fit the config ('gaussians.means'); the run is damaged: train again",
    ),
    "tensor NaN": (
        lambda run: resign(run, lambda tensors: tensors["gaussians.means"].fill_(float("nan"))),
        "state.safetensors: gaussians.means holds values that are not finite",
    ),
    "tensor of other shape": (lambda run: resign(run, shorten_means), "its tensors do not fit the config ("),
    "no config": (lambda run: (run / "config.json").unlink(), "is not a run (no config.json)"),
    "config unknown key": (
        lambda run: edit_json(run / "config.json", speed=3),
        "config.json: unknown field speed = 3, did you mean seed?",
    ),
    "config wrong type": (
        lambda run: edit_json(run / "config.json", seed="one"),
        "config.json: seed = 'one': input should be a valid integer",
    ),
    "config a list": (lambda run: (run / "config.json").write_text("[]"), "config.json: holds a JSON list"),
    "config nested": (lambda run: (run / "config.json").write_text("[" * 100_000), "config.json: is not valid JSON"),
    "run.json empty": (lambda run: (run / "run.json").write_text(""), "run.json: file is empty"),
    "run.json nested": (lambda run: (run / "run.json").write_text("[" * 100_000), "run.json: is not valid JSON"),
    "run.json binary": (lambda run: (run / "run.json").write_bytes(b"\xff\xfe"), "run.json: is not UTF-8 text"),
    "run.json without response": (
        lambda run: edit_json(run / "run.json", response=None),
        "run.json: response = None: input should be a valid dictionary",
    ),
    "run of version 0.2": (
        lambda run: edit_json(run / "run.json", format=2, version="0.2.0"),
        "run.json: format = 2 is of sehdr-warp 0.2.0, and this one reads format 3; train again (train PHOTOS --out",
    ),
    "response damaged": (
        lambda run: edit_json(run / "run.json", response={"kind": "table"}),
        "run.json: response: the stored table curve is damaged",
    ),
    "base exposure zero": (
        lambda run: edit_json(run / "run.json", base_time=0),
        "run.json: base_time = 0: input should be greater",
    ),
    "base exposure words": (
        lambda run: edit_json(run / "run.json", base_time="long"),
        "run.json: base_time = 'long': input should be a valid number",
    ),
    "base exposure NaN": (
        lambda run: edit_json(run / "run.json", base_time=float("nan")),
        "run.json: base_time = nan: input should be a finite number",
    ),
    "scene.json gone": (lambda run: (run / "scene.json").unlink(), CHANGED),
    "scene.json views": (lambda run: edit_json(run / "scene.json", views=3), CHANGED),
    "camera NaN": (
        lambda run: edit_view(run, fx=float("nan")),
        "scene.json: a view is damaged (ValueError('camera fx, fy, cx, cy = [nan,",
    ),
    "camera huge": (
        lambda run: edit_view(run, width=10**9, height=10**9),
        "scene.json: a view is damaged (ValueError('image size 1000000000 x 1000000000",
    ),
    "exposure zero": (
        lambda run: edit_view(run, exposure_time=0),
        "scene.json: views.exposure_time = 0: input should be greater than 0",
    ),
    "exposure in words": (
        lambda run: edit_view(run, exposure_time="short"),
        "scene.json: views.exposure_time = 'short': input should be a valid number",
    ),
}


@pytest.mark.parametrize("case", RUNS)
def test_damaged_runs(run, tmp_path, capfd, case):
    change, words = RUNS[case]
    change(run)
    before = snapshot(run)
    for arguments in (
        ("render", run, "--out", tmp_path / "out", "--device", "cpu"),
        ("eval", run, "--device", "cpu", "--json", tmp_path / "figures.json"),
        ("export", run, "--out", tmp_path / "scene.ply"),
    ):
        line = refused(capfd, *arguments)
        assert words in line and str(run) in line, arguments
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"] and snapshot(run) == before


def test_damaged_run_is_not_resumed(run, capfd):
    flip_byte(checkpoint_of(run) / "state.safetensors")
    before = snapshot(run)
    flags = ("--device", "cpu", "--resume")
    assert "SHA-256" in refused(capfd, "train", "embedded", "--out", run, *flags)
    assert snapshot(run) == before


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
    assert "no such folder" in refused(capfd, "render", tmp_path / "gone", "--out", tmp_path / "out")
    assert "dog.ply: is a file, not a run; give the folder" in refused(capfd, "eval", tmp_path / "dog.ply")
    assert snapshot(tmp_path) == before


def test_moved_photos(run, tmp_path, capfd):
    edit_json(run / "run.json", data={"path": str(tmp_path / "photos"), "exposure_index": None, "max_size": None})
    for arguments in (("eval", run), ("report", run, "--out", tmp_path / "report")):
        assert "--data" in refused(capfd, *arguments, "--device", "cpu")
    assert call("render", run, "--out", tmp_path / "out", "--device", "cpu", "--cameras", "train") == 0


CAMERAS = {
    "empty": "",
    "not JSON": "{",
    "a list": "[]",
    "nested": "[" * 100_000,
    "no cameras": '{"cameras": []}',
    "a number": '{"cameras": [7]}',
    "no pose": '{"cameras": [{"width": 8, "height": 8, "fx": 9, "fy": 9, "cx": 4, "cy": 4}]}',
    "huge": '{"cameras": [{"width": 65000, "height": 65000, "fx": 9, "fy": 9, "cx": 4, "cy": 4, "world_to_camera": '
    "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}",
    "name leaves": '{"cameras": [{"name": "../../x", "width": 8, "height": 8, "fx": 9, "fy": 9, "cx": 4, "cy": 4, '
    '"world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}',
    "NaN": '{"cameras": [{"width": 8, "height": 8, "fx": NaN, "fy": 9, "cx": 4, "cy": 4, '
    '"world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}',
}


@pytest.mark.parametrize("case", CAMERAS)
def test_camera_files(trained, tmp_path, capfd, case):
    (tmp_path / "path.json").write_text(CAMERAS[case])
    arguments = ("render", trained, "--out", tmp_path / "out", "--device", "cpu")
    assert "path.json" in refused(capfd, *arguments, "--cameras", tmp_path / "path.json")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "flags, words",
    [
        (("--evs=",), "evs: the list is empty"),
        (("--evs=nan",), "nan"),
        (("--evs=1,x",), "evs:"),
        (("--evs=0", "--exposures", "1"), "both are set"),
        (("--evs=0,0",), "twice"),
        (("--evs=900",), "900"),
        (("--exposures", "0"), "0"),
        (("--exposures=-1",), "-1"),
        (("--exposures", "inf"), "inf"),
        (("--multipart",), "exposures"),
        (("--ldr-brackets", "jpeg"), "exposures"),
        (("--cameras", "tset"), "tset"),
        (("--cameras", "orbit", "--count", "0"), "path of 0 views"),
        (("--cameras", "orbit", "--count", "-3"), "path of -3 views"),
        (("--cameras", "interpolate", "--count", "100000000"), "path of 100000000 views"),
        (("--cameras", "."), "holds no COLMAP model"),
        (("--colorspace", "cmyk"), "cmyk"),
        (("--device", "tpu"), "tpu"),
    ],
)
def test_render_flags(trained, tmp_path, capfd, flags, words):
    line = refused(capfd, "render", trained, "--out", tmp_path / "out", "--device", "cpu", *flags)
    assert words in line and not (tmp_path / "out").exists()


def test_nothing_is_replaced(trained, tmp_path, capfd):
    out = tmp_path / "out"
    arguments = ("render", trained, "--out", out, "--device", "cpu", "--evs=-2,0")
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
    assert "--overwrite" in refused(capfd, "export", trained, "--out", tmp_path / "scene.ply")
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "stops.png").write_text("mine")
    assert "--overwrite" in refused(capfd, "report", trained, "--out", tmp_path / "report", "--device", "cpu")
    assert (tmp_path / "scene.ply").read_text() == (tmp_path / "report" / "stops.png").read_text() == "mine"
    (tmp_path / "a.ply").mkdir()
    assert "is a file" in refused(capfd, "render", trained, "--out", tmp_path / "scene.ply", "--device", "cpu")
    assert "is a folder" in refused(capfd, "export", trained, "--out", tmp_path / "a.ply")
    several = ("--kind", "ldr", "--exposure", "1/60,1/125")
    assert call("export", trained, "--out", tmp_path / "b.ply", *several, "-q") == 2
    assert "one exposure; name one" in capfd.readouterr().err
    assert "no photo has a mask" in refused(capfd, "export", trained, "--out", tmp_path / "b.ply", "--mask-only")
    assert call("export", trained, "--out", tmp_path / "b.ply", "--data", tmp_path, "-q") == 2
    assert "only read for --mask-only" in capfd.readouterr().err


# --------------------------------------------------------------------------------------------- full disks and signals


@pytest.mark.parametrize(
    "command", [("render",), ("render", "--evs=-2,0,2", "--multipart"), ("export",), ("report",)], ids=" ".join
)
def test_full_disk(trained, tmp_path, capfd, command, coarse_figures):
    out = tmp_path / "out"
    out = out.with_suffix(".ply") if command[0] == "export" else out
    before = tmp_path / "before" / out.name
    assert call(command[0], trained, "--out", before, "--device", "cpu", *command[1:]) == 0, "kernels are compiled now"
    shutil.rmtree(before.parent)
    with full_disk():
        line = refused(capfd, command[0], trained, "--out", out, "--device", "cpu", *command[1:])
    assert "cannot be written" in line and ".tmp" not in line and list(tmp_path.iterdir()) == []


def test_full_disk_while_training_keeps_the_last_checkpoint(trained, tmp_path, capfd):
    out = tmp_path / "run"
    shutil.copytree(trained, out)
    values = json.loads((out / "config.json").read_text())
    values["schedule"]["iterations"] = 34
    (out / "config.json").write_text(json.dumps(values))
    resign(out, lambda tensors: None)
    before = snapshot(out / "checkpoints")
    flags = ("--device", "cpu", "--resume")
    with full_disk():
        line = refused(capfd, "train", "embedded", "--out", out, *flags)
    assert "cannot be written" in line and snapshot(out / "checkpoints") == before
    assert call("train", "embedded", "--out", out, *flags) == 0, "and goes on once there is room"


def test_read_only_place(trained, tmp_path, capfd, coarse_figures):
    """/proc takes no new files, not even root's."""
    for command in ("render", "export", "report"):
        line = refused(capfd, command, trained, "--out", "/proc/sehdr/out.ply")
        assert "/proc/sehdr" in line
    assert "/proc/sehdr" in refused(capfd, "train", "embedded", "--out", "/proc/sehdr", *LITTLE)


def start(*arguments) -> subprocess.Popen:
    # Tests that run in a shell's background have SIGINT ignored, and children inherit that.
    code = "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += "runpy.run_module('sehdr_warp', run_name='__main__')"
    command = [sys.executable, "-c", code, *(str(argument) for argument in arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)


def wait_for(process: subprocess.Popen, words: str) -> None:
    for line in process.stderr:
        if words in line:
            return
    raise AssertionError(f"{words!r} was never said; status {process.wait()}")


def test_interrupted_render_leaves_nothing(trained, tmp_path):
    process = start("render", trained, "--out", tmp_path / "out", "--cameras", "orbit", "--count", "2000", "--evs=-2,0")
    wait_for(process, " of 2000")
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


def test_kill_while_a_checkpoint_is_written(trained, tmp_path):
    """What a killed process leaves beside a checkpoint is not taken for one, and is cleared by the next."""
    out = tmp_path / "run"
    shutil.copytree(trained, out)
    whole = checkpoint_of(out)
    half = whole.with_name(f".{whole.name[:-1]}9.0123abcd.tmp")
    shutil.copytree(whole, half)
    (half / "checkpoint.json").unlink()
    torn = whole.with_name(f"{whole.name[:-1]}9")
    shutil.copytree(whole, torn)
    (torn / "state.safetensors").write_bytes((whole / "state.safetensors").read_bytes()[:1000])
    assert call("render", out, "--out", tmp_path / "views", "--device", "cpu") == 0
    assert call("train", "embedded", "--out", out, "--device", "cpu", "--resume") == 0
    assert [path.name for path in sorted((out / "checkpoints").iterdir()) if path != half] == [whole.name]


def test_a_folder_that_is_no_run_is_not_replaced_and_the_remedy_says_so(tmp_path):
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(InputError, match="is not a run .*; choose another folder for the run"):
        RunWriter(tmp_path).check(resume=False, overwrite=True)
    with pytest.raises(InputError, match="is not a run .*; give the folder that"):
        RunWriter(tmp_path).check(resume=True, overwrite=False)
