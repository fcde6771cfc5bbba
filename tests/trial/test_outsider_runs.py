"""Run folders of an outsider."""

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from .hostile import tried
from .outsider import DEEP, EITHER, FAR, IDENTITY, NAN, REFUSED, RENDER, STATE, case, put

pytestmark = pytest.mark.trial
VIEWS = ("views", 0)
FIELDS = [
    *(("scene.json", (*VIEWS, "camera", "width"), value) for value in (None, "a", [], {}, -1, 0, FAR, NAN, True, 2.5)),
    *(("scene.json", (*VIEWS, "camera", "fx"), value) for value in (NAN, 0, -1.0, "x")),
    *(("scene.json", (*VIEWS, "camera", "cx"), value) for value in (FAR, NAN)),
    ("scene.json", (*VIEWS, "camera", "world_to_camera"), [[1, 2], [3]]),
    ("scene.json", (*VIEWS, "camera", "world_to_camera"), [[NAN] * 4] * 4),
    ("scene.json", (*VIEWS, "camera", "world_to_camera"), [[1, 0, 0, FAR], *IDENTITY[1:]]),
    *(("scene.json", (*VIEWS, "name"), value) for value in ("../../x", "/x", "a/b", "..", "", "a\0b", "x" * 5000, 5)),
    *(("scene.json", (*VIEWS, "exposure_time"), value) for value in (0, -1, NAN, "1/2", None)),
    *(("run.json", ("base_time",), value) for value in (0, -1, NAN, "x", None)),
    *(("run.json", ("response",), value) for value in (None, 5, "x", {}, {"kind": "file", "path": "/dev/zero"})),
    *(("run.json", ("response",), {"kind": "analytic", "name": name}) for name in ("../x", "gamma-1e999", "gamma-0")),
    *(("run.json", ("normalization", "unit"), value) for value in (NAN, 0, -1, "x")),
    *(("run.json", ("up", "direction"), value) for value in ([NAN] * 3, [1], "y", [1, 0, 0, 0, 0])),
    *(("run.json", ("format",), value) for value in (99, -1, "3", None, 3.5, 10**30)),
    *(("config.json", ("model", "sh_degree"), value) for value in (-1, 9, 1e9, 10**12, "3", NAN)),
    ("config.json", ("__class__",), "os.system"),
]


def rehash(space: Path) -> None:
    """Make the hashes of a changed run fit: whoever sends a run can."""
    from sehdr_warp.errors import SehdrError
    from sehdr_warp.runs.run_folder import RunFolder

    file = (space / "run" / STATE).with_name("checkpoint.json")
    values = json.loads(file.read_text())
    try:
        values["run"] = RunFolder(space / "run").hashes()
    except SehdrError:  # Not even JSON
        return
    file.write_text(json.dumps(values))


@pytest.mark.parametrize(
    ("file", "place", "value", "codes"),
    [
        case(
            f"{file[:-5]}.{place[-1]} = {value!s:.24}", file, place, value, codes=EITHER if "name" in place else REFUSED
        )
        for file, place, value in FIELDS
    ],
)
def test_fields_of_a_run_of_an_outsider(space, file, place, value, codes):
    tree = at = json.loads((space / "run" / file).read_text())
    for key in place[:-1]:
        at = at.setdefault(key, {}) if isinstance(at, dict) else at[key]
    at[place[-1]] = value
    put(space / "run" / file, tree)
    rehash(space)
    tried(space, RENDER, codes)


RUN_FILES = ("config.json", "scene.json", "run.json", "plan.json", "summary.json", "metrics.jsonl", "extension.json")
RUN_FILES += ("confidence.safetensors", "orientation.json", "light_unit.json", "blocks.json")


@pytest.mark.parametrize("name", RUN_FILES)
@pytest.mark.parametrize("kind", ["fifo", "zero", "folder"])
@pytest.mark.parametrize("line", [RENDER, "compare run", "train --resume --out run --device cpu"])
def test_kinds_of_files_of_a_run_of_an_outsider(space, name, kind, line):
    put(space / "run" / name, kind)
    ended = tried(space, line, (1,))
    assert name in ended.err


TEXTS = (DEEP, "null", "{}" * 1000, '{"a":' * 900 + "1" + "}" * 900, b"\xff\xfe\x00{", "9" * 5000, "")


@pytest.mark.parametrize("name", ["run.json", "scene.json", "config.json", "summary.json", "plan.json"])
@pytest.mark.parametrize("number", range(len(TEXTS)))
def test_texts_of_a_run_of_an_outsider(space, name, number):
    put(space / "run" / name, TEXTS[number])
    reported = name in ("summary.json", "plan.json")
    line = "report run --out new --device cpu" if reported else RENDER
    tried(space, line, EITHER if reported and not TEXTS[number] else (1,))


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
def test_tensors_of_a_run_of_an_outsider(space, make, codes):
    import hashlib

    state = space / "run" / STATE
    state.write_bytes(make(state.read_bytes()))
    file = state.with_name("checkpoint.json")
    values = json.loads(file.read_text())
    put(file, values | {"sha256": hashlib.sha256(state.read_bytes()).hexdigest()})
    tried(space, RENDER, codes)
