"""Runs that were made to do harm: links, odd summaries, locks, and sets that changed below a training."""

import json
import os
from pathlib import Path

import pytest
from PIL import Image

from .harness import TRAIN, files_in
from .hostile import MARKUP, link, scripts_of, tried

pytestmark = pytest.mark.trial


RUN_LINKS = {
    "checkpoint folder": ("run/checkpoints/iteration_00000024", "../../precious"),
    "checkpoint values": ("run/checkpoints/iteration_00000024/checkpoint.json", "../../../precious/a.json"),
    "second checkpoint": ("run/checkpoints/iteration_00000099", "../../precious"),
    "link to itself": ("run/scene.json", "scene.json"),
    "link to a device": ("run/metrics.jsonl", "/dev/zero"),
    "link to a process": ("run/plan.json", "/proc/self/environ"),
    "link to passwords": ("run/summary.json", "/etc/passwd"),
    "link in .new": ("run/.new/config.json", "../../precious/a.json"),
    "link in .ready": ("run/.ready/checkpoints", "../../precious"),
    "folder of events": ("run/tensorboard", "/"),
    "orientation": ("run/orientation.json", "../precious/a.json"),
    "extension": ("run/extension.json", "../precious/a.json"),
}


@pytest.mark.parametrize("line", ["render run --out seen --device cpu", "train --resume --out run --device cpu -q"])
@pytest.mark.parametrize("name", RUN_LINKS)
def test_further_links_in_a_run(space, name, line):
    (space / "precious").mkdir()
    (space / "precious" / "a.json").write_text("{}")
    link(*RUN_LINKS[name])(space)
    ended = tried(space, line, codes=(1,))
    assert "is a link" in ended.err.splitlines()[-1]


REGION = {"photo": "r_0", "pixels": 1, "row": 1.0, "column": 1.0, "stops": 1.0, "box": [1, 2, 3, 4]}
SHAPES = {
    "summary.json": [
        "null",
        "[]",
        '""',
        "{}",
        "{",
        "",
        "\ufeff{}",
        "NaN",
        "[" * 100_000,
        '{"iteration": 1e400}',
        '{"format": 99}',
        '{"iteration": -1}',
        '{"train_seconds": NaN}',
        '{"device": "' + "x" * 100_000 + '"}',
        '{"iteration": ' + "9" * 5000 + "}",
        '{"a": 1, "a": 2}',
        '{"unexplained": {"regions": 1e9}}',
        json.dumps({"unexplained": {"regions": 1, "photos": 1, "worst": [REGION] * 5000}}),
        json.dumps({"unexplained": {"regions": 1, "photos": 1, "worst": [REGION | {"photo": "../../x"}]}}),
        json.dumps({"unexplained": {"regions": 1, "photos": 1, "worst": [REGION | {"row": -5, "column": 1e12}]}}),
        json.dumps({"unexplained": {"regions": 1, "photos": 1, "worst": [REGION | {"box": [9, 9, 1, 1]}]}}),
    ],
    "plan.json": [
        "null",
        "[1]",
        '{"decisions": null}',
        '{"decisions": {}}',
        '{"decisions": [[]]}',
        '{"decisions": [{"name": 1}]}',
        json.dumps({"decisions": [{"name": MARKUP, "choice": MARKUP, "reason": MARKUP, "fields": {MARKUP: MARKUP}}]}),
        json.dumps(
            {"decisions": [{"name": "x", "choice": "y", "reason": "z", "fields": {"a": {"b": [1] * 9999}}}] * 99}
        ),
    ],
    "metrics.jsonl": [
        "null\n",
        "[]\n",
        '{"iteration": "1"}\n',
        '{"iteration": 1, "psnr_ldr": 1e400}\n',
        '{"iteration": 1}\n' * 50_000,
        '{"iteration": -1, "seconds": -1}\n',
        "\0" * 1000,
        '{"iteration": 1, "psnr_ldr": null, "x": "' + MARKUP + '"}\n',
    ],
}
CASES = [(name, number) for name, shapes in SHAPES.items() for number in range(len(shapes))]


@pytest.mark.parametrize("name, number", CASES)
def test_shapes_of_summary_plan_and_metrics(space, name, number):
    (space / "run" / name).write_text(SHAPES[name][number])
    tried(space, "report run --out seen --device cpu")
    for page in (space / "seen").glob("*.html"):
        assert scripts_of(page.read_text()) == []
    tried(space, "compare run")


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
    ended = tried(space, line, made=("run",))
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
    ended = tried(space, line, codes=(0,) if kind in SAME else (0, 1), made=("run",))
    assert (ended.code == 0) == (kind in SAME), f"{kind}: went on without a word"
    assert ended.code == 0 or files_in(space / "run") == before
