"""Command lines as tired people and batch jobs type them: values of flags, names of output, environments, ranks."""

import os
from pathlib import Path

import pytest

from sehdr_warp.own_files import LIST

from .harness import COMMANDS, TRAIN, call, files_in
from .hostile import SHORT, case, put, tried

pytestmark = pytest.mark.trial


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
    "nan", "inf", "-inf", "1e300", "-1", "0", "", " ", "x", "9223372036854775808", "1e-320", "1,2,3", "½", "--", "\t",
)  # fmt: skip


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


OUTPUTS = [
    *(
        case(f"list of the folder: {kind}", kind, "export run --out new.ply --kind hdr --overwrite")
        for kind in ("fifo", "zero", "folder")
    ),
    case("a flag of 100,000 letters", None, "render run --" + "x" * 100_000),
    *(
        case(f"to {place}", None, f"export run --kind hdr --overwrite --out {place}")
        for place in ("/dev/full", "/dev/null", "/proc/x.ply", "a" * 300 + ".ply", "a/" * 2500 + "x.ply", "run", "..")
    ),
    case("10^6 x 10^6 pixels", None, "render run --out new --size 1000000x1000000"),
    case("10^18 views", None, "render run --out new --cameras orbit --count 1000000000000000000"),
    case("10^9 pixels around", None, "envmap run --out new.exr --size 1000000000"),
    case("10^6 voxels", None, "mesh run --out new.obj --resolution 1000000"),
]


@pytest.mark.parametrize(("kind", "line", "codes"), OUTPUTS)
def test_output(space, kind, line, codes):
    mine = space / ".sehdr-warp"
    if kind is not None:
        put(mine, kind)
    try:
        tried(space, f"{line} --device cpu" if " --xx" not in line else line, codes)
    finally:
        if kind is not None:
            os.rename(mine, space.parent / "list")


PROCESSES = ["9" * 5000, "-1", "0", "1", "1e3", "²", "٣", "auto2", "999999999999"]


@pytest.mark.parametrize("value", PROCESSES)
@pytest.mark.parametrize("flag", ["--blocks", "--gpus"])
def test_counts_of_processes(space, flag, value):
    codes = (0, 1, 2) if (flag, value) == ("--gpus", "1") else (1, 2)
    tried(space, f"{SHORT} {flag}={value}", codes=codes)
