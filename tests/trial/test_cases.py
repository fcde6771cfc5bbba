"""Obstacles, tampered runs, hostile photos, odd surroundings, signals, damaged caches: one line, nothing lost, nothing
started. Seeds are SEED and the number of the case."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.scene.images.hdr_files import read_hdr
from tests.fuzz.mutate import NUMBERS, VALUES
from tests.make_scenes import write_colmap

from .harness import COMMANDS, LATEST, SEED, TRAIN, call, files_in, limit_memory

pytestmark = pytest.mark.trial
TARGETS = {
    "render": "made/hdr", "export": "made/scene.ply", "export usd": "made/scene.usda", "report": "made/stops.png",
    "envmap": "made/light.exr", "eval": "made/figures.json", "synth": "set", "train": "run",
}  # fmt: skip
LINES = {**COMMANDS, "train": [*TRAIN, "--overwrite"]}


def obstruct(path: Path, kind: str) -> None:
    """Puts something of a user's where a command writes."""
    inside = next((file for file in sorted(path.rglob("[!.]*")) if file.is_file()), None) if path.is_dir() else path
    if kind == "edited" and path.name != "run":
        inside.write_bytes(inside.read_bytes() + b"mine")
    elif kind == "theirs" and path.is_dir():
        shutil.rmtree(path)
        (path / "checkpoints" / "iteration_00000001").mkdir(parents=True)
        for name in ("config.json", "metrics.jsonl", "checkpoints/iteration_00000001/weights.bin"):
            (path / name).write_text("{}")
    else:
        path.rename(path.with_name("kept"))
        if kind in ("link", "edited"):
            path.symlink_to("kept", target_is_directory=path.with_name("kept").is_dir())
            if path.name == "run":  # A folder may be a link; what is in it may not.
                path.unlink()
                shutil.copytree(path.with_name("kept"), path)
                (path / "checkpoints").rename(path.with_name("elsewhere"))
                (path / "checkpoints").symlink_to(path.with_name("elsewhere"))
        elif kind == "dangling":
            path.symlink_to("nowhere")
        elif kind == "pipe":
            os.mkfifo(path)
        elif kind == "theirs":
            path.write_text("mine")
        elif path.with_name("kept").is_dir():
            path.write_text("a file where a folder is wanted")
        else:
            path.mkdir()


@pytest.mark.parametrize("kind", ["theirs", "edited", "link", "dangling", "pipe", "other"])
@pytest.mark.parametrize("name", TARGETS)
def test_obstacles_are_kept(space, name, kind):
    obstruct(space / TARGETS[name], kind)
    before = files_in(space)
    ended = call(*LINES[name], folder=space)
    assert ended.code == 1 and files_in(space) == before


def leaves(node, place=()):
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield from leaves(value, (*place, key)) if isinstance(value, dict | list) and value else [(*place, key)]


@pytest.mark.parametrize("number", range(120))
def test_tampered_runs(space, prepared, number):
    """One value of a run is another, or none; half of the time its hashes are made to fit. Where a picture comes, it is
    the one that was trained."""
    rng, run, signed = random.Random(SEED * 1000 + number), space / "run", number % 2 == 1
    file = run / rng.choice(["run.json", "config.json", "scene.json", "summary.json", "metrics.jsonl"])
    if file.suffix == ".json":
        tree = json.loads(file.read_text())
        *place, last = rng.choice(list(leaves(tree)))
        node = tree
        for key in place:
            node = node[key]
        text = json.dumps(node[last])
        node[last] = "@"
        new = rng.choice(
            [*map(json.dumps, VALUES), *NUMBERS, "1e400", "NaN", '"\\ud800"', text + ', "twice": 1, "twice": 2']
        )
        file.write_bytes(json.dumps(tree).replace('"@"', new).encode("utf-8", "surrogatepass"))
    else:
        file.write_text(
            file.read_text() + rng.choice(["[", '{"iteration": 1, "psnr_ldr": "x"}\n', '{"iteration": true}\n'])
        )
    if signed:
        try:
            hashes = RunFolder(run).hashes()
        except Exception:  # noqa: BLE001 - not JSON any more
            hashes = {}
        state = next(run.glob("checkpoints/*/checkpoint.json"))
        state.write_text(json.dumps(json.loads(state.read_text()) | {"run": hashes}))
    shutil.rmtree(space / "made")
    ended = call(*COMMANDS["render"][:-1], folder=space)
    call("train", "--resume", "--out", "run", "-q", folder=space)
    if ended.code == 0 and not signed:
        for path in (space / "made" / "hdr").glob("[!.]*"):
            np.testing.assert_array_equal(read_hdr(path), read_hdr(prepared / "made" / "hdr" / path.name))


# Files of runs and sets, cameras and PLY have trials of their own.
INPUTS = {
    "run/checkpoints/*/state.safetensors": " ".join(COMMANDS["eval"]),
    "made/scene.usda": "convert made/scene.usda other.ply",
    "made/light.exr": "eval made --truth truth",
    "own.ocio": "render run --out new --ocio own.ocio --view Raw --device cpu",
    "own.toml": "train photos --out new --preset own.toml",
    "own.csv": "train photos --out new --iterations 2 --response own.csv --device cpu",
}


@pytest.mark.parametrize("name", INPUTS)
def test_inputs_that_are_pipes_are_not_waited_for(space, name):
    path = next(space.glob(name), space / name)
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    call(*INPUTS[name].split(), folder=space)


@pytest.mark.parametrize("mebibytes", [1, 4, 16, 64, 256])
@pytest.mark.parametrize("name", ["render", "report", "train", "export usd"])
def test_little_memory(space, name, mebibytes):
    before = files_in(space)
    ended = call(*LINES[name], folder=space, prepare=limit_memory(mebibytes))
    assert ended.code == 0 or files_in(space) == before


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_sparse_files_of_4_gib_are_not_read_whole(space, name):
    write_colmap(space / "model", 4, binary=False, size=(24, 16), params=(20.0, 21.0, 12.0, 8.0))
    os.truncate(space / "model" / "sparse" / "0" / f"{name}.txt", 4 << 30)
    ended = call("train", "model", "--out", "new", "--iterations", "2", "--device", "cpu", folder=space)
    assert ended.code == 1 and f"{name}.txt" in ended.err.splitlines()[-1]
    assert ended.memory < 1500, f"{ended.memory} MiB"


def test_two_trainings_do_not_mix(space):
    words = [word if word != "24" else "4000" for word in TRAIN]
    (space / "new").mkdir()
    words[words.index("run")] = "new"
    first = subprocess.Popen([sys.executable, "-m", "sehdr_warp", *words], cwd=space, stderr=subprocess.PIPE)
    try:
        while not (space / "new" / "run.json").exists():
            assert first.poll() is None
            time.sleep(0.1)
        for flag in ("--resume", "--overwrite"):
            ended = call(*words, flag, folder=space)
            assert ended.code == 1 and "another training is at work" in ended.err
        assert call("render", "new", "--out", "seen", "--device", "cpu", folder=space).code == 0
    finally:
        first.send_signal(signal.SIGTERM)
    assert b"Traceback" not in first.communicate(timeout=LATEST)[1] and first.returncode == 143
    assert call("train", "--resume", "--out", "new", "--iterations", "4000", "--help", folder=space).code == 0


S = f"exec {sys.executable} -m sehdr_warp"
LONG = "n" * 300
SURROUNDINGS = {
    "stdout closed": f"{S} presets --json >&-",
    "stdout full": f"{S} presets --json > /dev/full",
    "help, stdout full": f"{S} train --help > /dev/full",
    "stderr closed": f"{S} presets --json 2>&- | grep -q purpose",
    "all closed": f"{S} presets <&- >&- 2>&-",
    "stderr full": f"{S} export run --out new.ply --kind hdr 2> /dev/full",
    "train, stderr full": f"{S} train photos --out new --iterations 3 --device cpu 2> /dev/full",
    "train, stderr closed": f"{S} train photos --out new --iterations 3 --device cpu 2>&-",
    "reader gone": f"{S} train --help-all | head -1",
    "no HOME": f"unset HOME; {S} export run --out new.ply --kind hdr",
    "HOME missing": f"HOME=/dev/null/x {S} export run --out new.ply --kind hdr",
    "HOME of none": f"HOME=/proc/x {S} render run --out new --device cpu",
    "kernels' cache a file": f"WARP_CACHE_PATH=/dev/null {S} export run --out new.ply --kind hdr",
    "MPLBACKEND": f"MPLBACKEND=nonsense {S} report run --out new --device cpu",
    "long name": f"{S} render {LONG} --out new",
    "long output": f"{S} export run --kind hdr --out {LONG}.ply",
    "long path": f"{S} render {'a/' * 3000} --out new",
    "long photos": f"{S} train {LONG} --out new",
    "long run": f"{S} train photos --out {LONG} --iterations 2",
    "not UTF-8": f"{S} train $'/tmp/\\xff' --out new",
    "not UTF-8 out": f"{S} export run --kind hdr --out $'n\\xff.ply'",
    "run not UTF-8": f"cp -r run $'r\\xff'; {S} render $'r\\xff' --out new --device cpu",
    "NUL and newline": f"{S} export run --kind hdr --out $'a\\nb.ply'",
    "a file for a run": f"{S} render photos/transforms.json --out new",
    "no locale": f"LC_ALL=C PYTHONIOENCODING=ascii {S} train --help",
    "few files": f"ulimit -n 16; {S} export run --kind hdr --out new.ply",
    "full disk": f"ulimit -f 2; {S} render run --out new --device cpu",
    **{f"{k} kB of space": f"ulimit -v {k}; {S} export run --out new.ply" for k in (300000, 500000, 600000, 1200000)},
} | {f"{columns} columns": f"COLUMNS={columns} {S} {words}" for columns in (1, 3, 5) for words in ("train --help",)}


@pytest.mark.parametrize("name", SURROUNDINGS)
def test_surroundings(space, name):
    environment = {key: value for key, value in os.environ.items() if key not in ("SEHDR_THREADS", "MPLBACKEND")}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    before = files_in(space / "run")
    ended = subprocess.run(
        ["bash", "-c", SURROUNDINGS[name]], cwd=space, env=environment, capture_output=True, timeout=LATEST, check=False
    )
    output = ended.stderr.decode(errors="replace")
    assert "Traceback" not in output and "Error:" not in output and ended.returncode in (0, 1, 141), output
    assert ended.returncode != 1 or "closed" in name or output.splitlines()[-1].startswith("sehdr-warp: "), output
    assert files_in(space / "run") == before


@pytest.mark.parametrize("number", range(20))
def test_interrupts(space, number):
    """Ctrl-C at any time, once or three times, and the signals of machines and terminals."""
    rng = random.Random(SEED * 1000 + number)
    kind = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP][0 if number < 14 else number % 2 + 1]
    words = [word if word not in ("24", "run") else {"24": "100000", "run": "new"}[word] for word in TRAIN]
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += "signal.signal(signal.SIGHUP, signal.SIG_DFL); "  # The trial may itself run under nohup.
    code += "import runpy; runpy.run_module('sehdr_warp', run_name='__main__')"
    child = subprocess.Popen(
        [sys.executable, "-c", code, *words], cwd=space, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    time.sleep(rng.uniform(0.3, 6))
    for _ in range(3 if number % 2 and kind == signal.SIGINT else 1):
        child.send_signal(kind)
        time.sleep(0.02)
    output = child.communicate(timeout=LATEST)[1].decode()
    assert "Traceback" not in output and child.returncode in (128 + kind, -kind), output
    if (space / "new" / "run.json").exists():
        assert RunFolder(space / "new").newest_checkpoint().tensors
