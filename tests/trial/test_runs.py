"""Runs that are damaged or were made to do harm, their locks, and sets that changed below a training."""

import json
import os
import random
import re
import struct
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.fuzz.mutate import VALUES

from .harness import SEED, TRAIN, call, files_in
from .hostile import DEEP, EITHER, NAN, REFUSED, RENDER, STATE, case, put, tried

pytestmark = pytest.mark.trial

RUN_FILES = ("config.json", "scene.json", "run.json", "plan.json", "summary.json", "metrics.jsonl", "extension.json")
RUN_FILES += ("confidence.safetensors", "orientation.json", "light_unit.json", "blocks.json")


RESUME = "train --resume --out run --device cpu"


@pytest.mark.parametrize("name", RUN_FILES)
@pytest.mark.parametrize("line, kind", [(RENDER, "fifo"), (RENDER, "zero"), (RENDER, "folder"), (RESUME, "fifo")])
def test_kinds_of_files_of_a_run(space, name, kind, line):
    put(space / "run" / name, kind)
    ended = tried(space, line, (1,))
    assert name in ended.err


def tensors(**changes: Any):
    """Another description of the checkpoint's means; `body` replaces the whole file."""

    def make(data: bytes) -> bytes:
        length = struct.unpack("<Q", data[:8])[0]
        header = json.loads(data[8 : 8 + length])
        header["gaussians.means"] |= changes
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + data[8 + length :]

    return make


def filled(name: str, value: float):
    """The checkpoint with one value in all of a tensor."""

    def make(data: bytes) -> bytes:
        length = struct.unpack("<Q", data[:8])[0]
        first, last = json.loads(data[8 : 8 + length])[f"gaussians.{name}"]["data_offsets"]
        first, last = first + 8 + length, last + 8 + length
        return data[:first] + struct.pack("<f", value) * ((last - first) // 4) + data[last:]

    return make


TENSORS = [
    case("header of 2^63", lambda data: struct.pack("<Q", 2**63) + b"{}"),
    case("header of 90 MB", lambda data: struct.pack("<Q", 90_000_000) + bytes(90_000_000)),
    case("header, deep", lambda data: struct.pack("<Q", 100_000) + DEEP.encode() + data),
    case("a pickle", lambda data: b"\x80\x04\x8c\x05posix\x8c\x06system\x93\x8c\x08touch pw\x85R."),
    case("an archive", lambda data: b"PK\x03\x04" + bytes(1000)),
    case("empty", lambda data: b""),
    *(
        case(f"{name} = {value!s:.20}", tensors(**{name: value}))
        for name, value in (
            ("shape", [2**40, 2**40]), ("shape", [-1, 3]), ("shape", []), ("shape", "x"), ("dtype", "F64"),
            ("dtype", "\x1b[31mX"), ("dtype", "I32"), ("data_offsets", [10**12, 10**12 + 9]), ("data_offsets", [9, 3]),
        )
    ),
    *(
        case(f"{name} of {value}", filled(name, value), codes=EITHER if abs(value) < 1e39 else REFUSED)
        for name, value in (
            ("means", NAN), ("means", float("inf")), ("means", 1e38), ("log_scales", 88.0), ("log_scales", -3e38),
            ("opacity_logits", float("inf")), ("quaternions", 0.0), ("quaternions", NAN), ("harmonics_dc", 3e38),
            ("harmonics_dc", NAN), ("harmonics_rest", 1e20),
        )
    ),
]  # fmt: skip


@pytest.mark.parametrize(("make", "codes"), TENSORS)
def test_tensors_of_a_run(space, make, codes):
    import hashlib

    state = space / "run" / STATE
    state.write_bytes(make(state.read_bytes()))
    file = state.with_name("checkpoint.json")
    values = json.loads(file.read_text())
    put(file, values | {"sha256": hashlib.sha256(state.read_bytes()).hexdigest()})
    tried(space, RENDER, codes)


def locked(kind: str, space: Path) -> None:
    lock = space / "run" / ".lock"
    lock.unlink(missing_ok=True)
    {
        "folder": lambda: lock.mkdir(),
        "full folder": lambda: (lock / "a").mkdir(parents=True),
        "pipe": lambda: os.mkfifo(lock),
        "link": lambda: lock.symlink_to("../precious"),
        "dangling": lambda: lock.symlink_to("nowhere"),
        "text": lambda: lock.write_text("4294967295\n" * 1000),
        "sparse": lambda: (lock.touch(), os.truncate(lock, 1 << 26)),
    }[kind]()


@pytest.mark.parametrize("line", ["train --resume --out run --device cpu -q", " ".join([*TRAIN, "--overwrite", "-q"])])
@pytest.mark.parametrize("kind", ["folder", "full folder", "pipe", "link", "dangling", "text", "sparse"])
def test_locks_that_are_no_locks(space, kind, line):
    (space / "precious").write_text("mine")
    locked(kind, space)
    ended = tried(space, line, made=("run", "cache"))
    assert (ended.code == 0) == (kind in ("text", "sparse", "pipe"))


def change_set(kind: str, photos: Path) -> None:
    first = min((photos / "images").glob("*.png"))
    description = json.loads((photos / "transforms.json").read_text())
    frames = description["frames"]
    if kind == "pixels":
        Image.open(first).convert("RGB").point(lambda value: 255 - value).save(first)
    elif kind == "one pixel":
        image = Image.open(first).convert("RGB")
        image.putpixel((3, 3), tuple(255 - value for value in image.getpixel((3, 3))))
        image.save(first)
    elif kind == "swapped":
        second = sorted((photos / "images").glob("*.png"))[1]
        data = first.read_bytes()
        first.write_bytes(second.read_bytes())
        second.write_bytes(data)
    elif kind == "smaller":
        image = Image.open(first)
        image.resize((image.width // 2, image.height // 2)).save(first)
    elif kind == "removed":
        first.unlink()
    elif kind == "renamed":
        first.rename(first.with_name("other.png"))
        frames[0]["file_path"] = "images/other.png"
    elif kind == "camera":
        frames[0]["transform_matrix"][0][3] += 0.25
    elif kind == "fewer":
        frames.pop()
    elif kind == "mask":
        (photos / "masks").mkdir()
        Image.new("L", (24, 16), 0).save(photos / "masks" / first.name)
    elif kind == "times":
        names = [path.name for path in sorted((photos / "images").glob("*.png"))]
        (photos / "exposures.json").write_text(json.dumps(dict.fromkeys(names, 1.0) | {first.name: 9.0}))
    elif kind == "date":
        os.utime(first, (1, 1))
    elif kind == "saved again":
        Image.open(first).save(first, compress_level=0)
    (photos / "transforms.json").write_text(json.dumps(description))


SAME = ("date", "saved again")


CHANGES = ("pixels", "one pixel", "swapped", "smaller", "removed", "renamed", "camera", "fewer", "mask", "times", *SAME)


@pytest.mark.parametrize("kind", CHANGES)
def test_sets_that_changed_below_a_training(space, kind):
    change_set(kind, space / "photos")
    before = files_in(space / "run")
    line = "train photos --resume --out run --iterations 26 --device cpu -q"
    ended = tried(space, line, codes=(0,) if kind in SAME else (0, 1), made=("run", "cache"))
    assert (ended.code == 0) == (kind in SAME), f"{kind}: went on without a word"
    assert ended.code == 0 or files_in(space / "run") == before


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
