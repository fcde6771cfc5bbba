"""What strangers send, and what tired people type: one line, or the right result.

Runs with links, summaries of any shape, films, splats, LUTs, cameras, flags, names, environments. Nothing is moved,
run, waited for or connected to.
"""

import json
import os
import random
import re
import shutil
import struct
from pathlib import Path

import pytest

from sehdr_warp.own_files import LIST
from tests.fuzz.mutate import VALUES
from tests.ocio_config import ocio_config

from .harness import COMMANDS, SEED, TRAIN, call, files_in

pytestmark = pytest.mark.trial
RUN_FILES = (
    "config.json", "scene.json", "run.json", "plan.json", "summary.json", "metrics.jsonl", "confidence.safetensors",
    "checkpoints", ".lock", "tensorboard", ".new", ".ready", "checkpoints/iteration_00000024/state.safetensors",
)  # fmt: skip
LOOKS = {
    "render": "render run --out seen --device cpu", "export": "export run --out seen.ply",
    "eval": "eval run --device cpu", "compare": "compare run", "report": "report run --out seen --device cpu",
    "envmap": "envmap run --out seen.exr --size 32 --device cpu", "resume": "train --resume --out run --device cpu",
    "overwrite": " ".join([*TRAIN, "--overwrite"]),
}  # fmt: skip


@pytest.mark.parametrize("name", RUN_FILES)
@pytest.mark.parametrize("look", LOOKS)
def test_links_in_a_sent_run(space, look, name):
    """Each to something of the user's with that name, which would do."""
    file, precious = space / "run" / name, space / "precious"
    if file.exists():
        shutil.move(file, precious)
    else:
        precious.mkdir()
        (precious / "thesis.txt").write_text("mine")
    file.symlink_to(os.path.relpath(precious, file.parent))
    before = files_in(space)
    ended = call(*LOOKS[look].split(), folder=space)
    assert ended.code == 1 and "is a link" in ended.err.splitlines()[-1] and files_in(space) == before


SCRIPT = "</script><script>PWNED</script><img src=x onerror=PWNED>"


def spoil(tree, rng: random.Random) -> None:
    """Puts a value of any kind, or markup, in the place of one that is there."""
    while True:
        key = rng.choice(list(tree) if isinstance(tree, dict) else range(len(tree)))
        inner = tree[key]
        if isinstance(inner, dict | list) and inner and rng.random() < 0.7:
            tree = inner
            continue
        tree[key] = rng.choice([*VALUES, SCRIPT, SCRIPT, [SCRIPT], {SCRIPT: SCRIPT}])
        return


@pytest.mark.parametrize("number", range(60))
def test_what_a_sent_run_says_of_itself(space, number):
    """Summary, plan, scene or run with one value that is another: a page without script, or a line."""
    rng = random.Random(SEED * 1000 + number)
    file = space / "run" / f"{rng.choice(['summary', 'summary', 'plan', 'plan', 'scene', 'run'])}.json"
    if not file.exists():
        pytest.skip("this training has no plan")
    tree = json.loads(file.read_text())
    spoil(tree, rng)
    file.write_bytes(json.dumps(tree).encode("utf-8", "surrogatepass"))
    run = files_in(space / "run")
    for line in ("report run --out seen --device cpu", "compare run", "train --resume --out run --device cpu -q"):
        call(*line.split(), folder=space)
        if "resume" not in line:
            assert files_in(space / "run") == run
    for page in (space / "seen").glob("*.html"):
        tags = re.findall(r"<(?:script|img)[^>]*>", page.read_text().partition("<main>")[2].rpartition("<script>")[0])
        assert not any("PWNED" in tag or "onerror" in tag for tag in tags) and "<script>PWNED" not in page.read_text()


FILMS = {
    **dict.fromkeys(
        ("film.mp4", "film.mov", "film.MP4", "tour-12:30.mp4", "a b.mp4", "ü%03d.mp4", "-y.mp4", "film.mkv"), 0),
    **dict.fromkeys(
        ("film.mpd", "film.m3u8", "film.ism", "film.gif", "film%d.png", "film.sdp", "film.ffmeta", "film", "film.mp4.",
         ".mp4", "film.tee", "pipe:1", "http://127.0.0.1:9/film.mp4", "rtmp://127.0.0.1/film.mp4",
         "file:///tmp/film.mp4", "concat:a|b.mp4/x", "/dev/null", "/dev/stdout", "/proc/film.mp4"), 1),
}  # fmt: skip


@pytest.mark.parametrize("name", FILMS)
def test_films(space, name):
    pytest.importorskip("av")
    (space / "d").mkdir()
    for own in ("init-stream0.m4s", "chunk-stream0-00001.m4s", "film0.ts", "film.mp4.txt"):
        (space / "d" / own).write_text("the user's own")
    before = files_in(space)
    place = name if "/" in name or name.startswith("pipe:") else f"d/{name}"
    ended = call("render", "run", "--video", place, "--cameras", "all", "--device", "cpu", folder=space)
    created = {path: files_in(space)[path] for path in files_in(space) if path not in before and LIST not in path}
    assert ended.code == FILMS[name], ended.err
    assert list(created) == ([f"d/{name}"] if ended.code == 0 else [])
    assert {path: text for path, text in files_in(space).items() if path in before} == before


def glb(space: Path, change) -> None:
    """A .glb of the run, with its description changed."""
    data = (space / "files" / "a.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    described, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    change(described)
    text = json.dumps(described).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    (space / "b.glb").write_bytes(head + text + struct.pack("<2I", len(binary), 0x4E4942) + binary)


def set_all(key: str, **values):
    def change(described):
        for each in described[key]:
            each.update(values)

    return change


def both(*changes):
    return lambda described: [change(described) for change in changes]


GLBS = {
    **{f"stride {s}": set_all("bufferViews", byteStride=s) for s in (0, -4, 1, 2**31, 2**63, 1.5, "4", None)},
    **{f"count {c}": set_all("accessors", count=c) for c in (0, -1, 2**31, 10**9, 2**64, 1.5, "9", None)},
    **{f"count {c} without stride": both(
        set_all("bufferViews", byteStride=0, byteOffset=0), set_all("accessors", count=c))
       for c in (20_000_000, 500_000_000, 2_000_000_000)},
    **{f"offset {o}": set_all("bufferViews", byteOffset=o) for o in (-1, 2**31, 2**64, 0.5, "0")},
    **{f"base time {t}": (lambda d, t=t: d["meshes"][0]["extras"].update(base_exposure_time=t))
       for t in (0, -1, 1e-320, 1e300, 1e-13, "x", None, [1])},
}  # fmt: skip


@pytest.mark.parametrize("name", GLBS)
def test_gltf_of_strangers(space, name):
    glb(space, GLBS[name])
    ended = call("convert", "b.glb", "b.ply", folder=space)
    assert ended.code == 1 and "b.glb" in ended.err.splitlines()[-1] and not (space / "b.ply").exists()
    assert ended.memory < 1500, f"{ended.memory} MiB"


@pytest.mark.parametrize(
    "value", ["1e-320", "5e-324", "1e-13", "1e13", "1e308", "0", "-1", "nan", "inf", "x", "1_0", "½"]
)
def test_base_times_of_ply(space, value):
    text = (space / "made" / "scene.ply").read_bytes()
    (space / "a.ply").write_bytes(re.sub(rb"base_exposure_time \S+", f"base_exposure_time {value}".encode(), text))
    ended = call("convert", "a.ply", "b.ply", folder=space)
    assert ended.code == int(value != "1_0"), ended.err


LUTS = {
    "missing": "no.cube", "damaged": "bad.cube", "passwd": "/etc/passwd", "pipe": "pipe.cube", "zero": "/dev/zero",
    "random": "/dev/urandom", "folder": "d", "link to a device": "zero.cube", "up": "../../../../etc/passwd",
    "sparse": "sparse.cube", "empty": "empty.cube", "name": "a\\0b", "long": "n" * 5000,
}  # fmt: skip
TRANSFORMS = {name: f"!<FileTransform> {{src: '{path}'}}" for name, path in LUTS.items()} | {
    "cycle": "!<ColorSpaceTransform> {src: out, dst: raw}",
    "unknown space": "!<ColorSpaceTransform> {src: nowhere, dst: raw}",
    "no transform": "!<Nothing> {}",
    "numbers": "!<MatrixTransform> {matrix: [1, 2, 3]}",
    "not yaml": "{[",
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_ocio_configs(space, name):
    pytest.importorskip("PyOpenColorIO")
    (space / "bad.cube").write_text("LUT_3D_SIZE 2\n0 0 0\n")
    (space / "empty.cube").write_text("")
    (space / "sparse.cube").write_text("LUT_3D_SIZE 2\n")
    os.truncate(space / "sparse.cube", 4 << 30)
    os.mkfifo(space / "pipe.cube")
    (space / "zero.cube").symlink_to("/dev/zero")
    (space / "d").mkdir()
    (space / "own.ocio").write_text(ocio_config(TRANSFORMS[name]))
    ended = call(
        *["render", "run", "--out", "seen", "--ocio", "own.ocio", "--view", "V", "--device", "cpu"],
        folder=space,
        seconds=60,
    )
    assert ended.code == 1 and ended.memory < 1500 and len(ended.err.splitlines()[-1]) < 1000


@pytest.mark.parametrize("number", range(40))
def test_cameras_of_strangers(space, number):
    rng = random.Random(SEED * 1000 + number)
    camera = {"name": "a", "width": 24, "height": 24, "fx": 30, "fy": 30, "cx": 12, "cy": 12}
    camera["world_to_camera"] = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    sizes = (0, 1, 2**20, 2**20 + 1, 2_000_000, 10**9, 2**63)
    if number < 10:
        camera |= {"width": rng.choice(sizes), "height": 1 if number % 2 else rng.choice(sizes)}
    else:
        camera[rng.choice(list(camera))] = rng.choice([*VALUES, 1e-300, 1e30, -1e9])
    (space / "own.json").write_bytes(json.dumps({"cameras": [camera]}).encode("utf-8", "surrogatepass"))
    before = files_in(space)
    ended = call(*["render", "run", "--out", "seen", "--cameras", "own.json", "--device", "cpu"], folder=space)
    assert ended.memory < 4000, f"{ended.memory} MiB"
    assert ended.code == 0 or files_in(space) == before


FLAGS = {
    "--fps": "render run --cameras all --video seen.mp4 --device cpu",
    "--size": "envmap run --out seen.exr --device cpu",
    "--evs": "render run --out seen --device cpu",
    "--ev-ramp": "render run --cameras all --video seen.mp4 --device cpu",
    "--max-size": "train photos --out new --preset demo --iterations 2 --device cpu",
    "--holdout": "train photos --out new --preset demo --iterations 2 --device cpu",
    "--seed": "train photos --out new --preset demo --iterations 2 --device cpu",
    "--port": "view run --device cpu",
}  # fmt: skip
TYPED = (
    "nan",
    "inf",
    "-inf",
    "1e300",
    "-1",
    "0",
    "",
    " ",
    "x",
    "9223372036854775808",
    "1e-320",
    "1,2,3",
    "½",
    "--",
    "\t",
)


@pytest.mark.parametrize("value", TYPED)
@pytest.mark.parametrize("flag", FLAGS)
def test_values_of_flags(space, flag, value):
    if flag == "--port" and value == "0":
        pytest.skip("this is any free port")
    before = files_in(space)
    ended = call(*FLAGS[flag].split(), f"{flag}={value}", folder=space, seconds=120)
    assert ended.code in (0, 1, 2)
    assert ended.code == 0 or files_in(space) == before


NAMES = ("a\nb", "-x", "tour 12:30", "ü", "%d", "~", "n" * 200, "$(id)", "a" + chr(0x202E) + "b", "'", '"', "\\")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("command", ["render", "export", "report", "envmap", "eval", "synth"])
def test_names_of_output(space, command, name):
    """The right file with that name, and no other."""
    words, flag = COMMANDS[command], "--json" if command == "eval" else "--out"
    place = words[words.index(flag) + 1]
    suffix = Path(place).suffix
    name += suffix
    new = [f"{flag}={name}" if word == flag else word for word in words if word != place]
    before = files_in(space)
    ended = call(*new, folder=space)
    created = {Path(path).parts[0] for path in files_in(space) if path not in before} - {LIST}
    assert ended.code == 0 and created == {name}, ended.err


ENVIRONMENTS = {
    "rank alone": {"RANK": "1", "WORLD_SIZE": "2"},
    "rank without a place": {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "MASTER_PORT": "1"},
    "several machines": {"RANK": "0", "WORLD_SIZE": "4", "LOCAL_WORLD_SIZE": "2"},
    "no rank": {"RANK": "x", "WORLD_SIZE": "y"},
    "threads": {"SEHDR_THREADS": "-1"},
    "many threads": {"SEHDR_THREADS": "x" * 1000},
    "columns": {"COLUMNS": "0"},
    "cache": {"XDG_CACHE_HOME": "/dev/null"},
    "pipes": {"TMPDIR": "/nowhere"},
}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_environments(space, name):
    words = [word if word != "run" else "new" for word in TRAIN]
    ended = call(*words, "-q", folder=space, prepare=lambda: os.environ.update(ENVIRONMENTS[name]))
    refused = "rank alone", "no rank", "rank without a place", "several machines"
    assert ended.code == (1 if name in refused else 0), ended.err


def test_a_batch_job_that_always_resumes(space):
    words = [word if word != "run" else "new" for word in TRAIN]
    assert call(*words, "--resume", folder=space).code == 0
    assert call(*words, "--resume", folder=space).code == 0
