"""Blocks, facts beside a run, streamed SOG, compressed PLY and counts of processes, made to do harm."""

import json
import shutil
import struct

import pytest

from .hostile import MARKUP, SHORT, tried

pytestmark = pytest.mark.trial

PLAN = {
    "format": 1,
    "scene": "photos",
    "data": {"path": "photos", "exposure_index": None, "max_size": None, "holdout": None},
    "response": {"kind": "analytic", "name": "hdr-nerf"},
    "base_time": 1.0,
    "normalization": {"center": [0, 0, 0], "unit": 1.0},
    "exposure_compensation": None,
    "exposure_times": {"r_0": 1.0},
    "config": {"schedule": {"iterations": 2}},
    "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "blocks": [
        {
            "name": "block_0",
            "views": ["r_0"],
            "fraction": 1.0,
            "low": [None] * 3,
            "high": [None] * 3,
            "margin": [0.1] * 3,
        }
    ],
}
BLOCKS = {
    "empty": "",
    "a list": "[]",
    "deep": "[" * 100_000,
    "no blocks": json.dumps(PLAN | {"blocks": []}),
    "100,000 blocks": json.dumps(
        PLAN | {"blocks": [PLAN["blocks"][0] | {"name": f"block_{number}"} for number in range(100_000)]}
    ),
    "a block above": json.dumps(PLAN | {"blocks": [PLAN["blocks"][0] | {"name": "../../precious"}]}),
    "markup": json.dumps(PLAN | {"scene": MARKUP, "response": {"kind": MARKUP, "name": MARKUP}}),
    "photos of others": json.dumps(PLAN | {"data": PLAN["data"] | {"path": "/etc"}}),
    "axes of zeros": json.dumps(PLAN | {"axes": [[0, 0, 0]] * 3}),
    "a base time of 1e-320": json.dumps(PLAN | {"base_time": 1e-320}),
    "a response of a file": json.dumps(PLAN | {"response": {"kind": "table", "path": "/etc/passwd"}}),
    "options of none": json.dumps(PLAN | {"config": PLAN["config"] | {"model": {"init_file": "/dev/zero"}}}),
}


@pytest.mark.parametrize("name", BLOCKS)
def test_plans_of_blocks(space, name):
    """Tamper with a run that a training would resume."""
    (space / "precious").mkdir()
    (space / "precious" / "a.txt").write_text("mine")
    (space / "new").mkdir()
    (space / "new" / "blocks.json").write_text(BLOCKS[name])
    ended = tried(space, "train photos --resume --out new --device cpu -q", seconds=100)
    assert "root:" not in ended.err


FACTS = {
    "light_unit.json": [
        "[]",
        '{"luminance": 1e400, "pixel": [0, 0], "view": "r_0", "reading": "x"}',
        '{"luminance": 100, "pixel": ["x", 0], "view": "r_0", "reading": "x"}',
        json.dumps({"luminance": 100.0, "pixel": [0, 0], "view": MARKUP, "reading": MARKUP + "\x1b[2J"}),
        json.dumps({"luminance": 100.0, "pixel": [10**400, 0], "view": "r_0", "reading": "x"}),
    ],
    "orientation.json": ["[]", '{"up": [0, 0, 0], "scale": 1}', '{"up": [NaN, 0, 1], "scale": -1}', "[" * 100_000],
    "extension.json": ["[]", '{"iterations": 1e400}', '{"iterations": -5}'],
}
DATA = [{"path": "/dev/zero"}, {"path": "a\0b"}, {"path": "n" * 100_000}, {"max_size": 10**400}, {"holdout": -1}]


@pytest.mark.parametrize("name, number", [(name, n) for name, texts in FACTS.items() for n in range(len(texts))])
def test_facts_beside_a_run(space, name, number):
    (space / "run" / name).write_text(FACTS[name][number])
    tried(space, "lights run --out seen.json --device cpu")
    tried(space, "export run --out seen.usda")
    tried(space, "train --resume --out run --device cpu -q", made=("run",))


@pytest.mark.parametrize("number", range(len(DATA)))
def test_load_arguments_of_a_run(space, number):
    """State odd places of photos in a run."""
    values = json.loads((space / "run" / "run.json").read_text())
    values["data"] |= DATA[number]
    (space / "run" / "run.json").write_text(json.dumps(values))
    ended = tried(space, "eval run --device cpu")
    assert "root:" not in ended.err


def node(**part):
    return {"bound": {"min": [0, 0, 0], "max": [1, 1, 1]}, "lods": {"0": {"file": 0, "offset": 0, "count": 1} | part}}


def circle(depth: int):
    tree = node()
    for _ in range(depth):
        tree = {"bound": tree["bound"], "children": [tree]}
    return tree


STREAMED = {
    "a chunk above": {"filenames": ["../../precious/meta.json"]},
    "a chunk of the disk": {"filenames": ["/etc/passwd"]},
    "a chunk of a device": {"filenames": ["/dev/zero"]},
    "a chunk of 10^18": {"tree": node(file=10**18)},
    "a count of 10^18": {"tree": node(count=10**18)},
    "an offset below 0": {"tree": node(offset=-5)},
    "a count of a text": {"tree": node(count="9" * 5000)},
    "deep": {"tree": circle(400)},
    "no tree": {"tree": None},
    "names of numbers": {"filenames": [7]},
    "no chunk": {"filenames": []},
}


@pytest.mark.parametrize("name", STREAMED)
def test_indexes_of_streamed_sog(space, name):
    meta = {"version": 1, "count": 1, "counts": [1], "lodLevels": 1, "filenames": ["0_0/meta.json"], "tree": node()}
    (space / "town").mkdir()
    (space / "town" / "lod-meta.json").write_text(json.dumps(meta | STREAMED[name]))
    ended = tried(space, "convert town/lod-meta.json seen.ply", codes=(1,))
    assert "root:" not in ended.err


COMPRESSED = {
    "chunks of 10^12": (b"element chunk 1", b"element chunk 1000000000000"),
    "an element below 0": (b"element vertex ", b"element vertex -"),
    "no format": (b"format binary_little_endian 1.0\n", b""),
    "bounds of another type": (b"property float min_x", b"property double min_x"),
    "bounds of another name": (b"property float max_z", b"property float max_q"),
}


@pytest.mark.parametrize("name", COMPRESSED)
def test_headers_of_compressed_ply(space, name):
    data = (space / "files" / "a.compressed.ply").read_bytes()
    old, new = COMPRESSED[name]
    assert old in data
    (space / "b.compressed.ply").write_bytes(data.replace(old, new, 1))
    shutil.rmtree(space / "files")
    tried(space, "convert b.compressed.ply seen.ply", codes=(1,))


def test_bounds_of_compressed_ply_that_are_no_numbers(space):
    data = (space / "files" / "a.compressed.ply").read_bytes()
    end = data.index(b"end_header\n") + 11
    (space / "b.compressed.ply").write_bytes(data[:end] + struct.pack("<18f", *[float("nan")] * 18) + data[end + 72 :])
    ended = tried(space, "convert b.compressed.ply seen.ply")
    assert ended.code or "are not finite and were left out" in ended.err


PROCESSES = ["9" * 5000, "-1", "0", "1", "1e3", "²", "٣", "auto2", "999999999999"]


@pytest.mark.parametrize("value", PROCESSES)
@pytest.mark.parametrize("flag", ["--blocks", "--gpus"])
def test_counts_of_processes(space, flag, value):
    codes = (0, 1, 2) if (flag, value) == ("--gpus", "1") else (1, 2)
    tried(space, f"{SHORT} {flag}={value}", codes=codes)
