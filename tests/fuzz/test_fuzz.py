"""A small share of `python -m tests.fuzz` with a fixed seed, and the tool itself."""

import random

import pytest

from sehdr_warp import sandbox
from sehdr_warp.errors import InputError

from .mutate import mutate
from .reader import Reader, Workspace
from .readers import READERS
from .run import fork_server, fuzz, make_input, share, try_input


@pytest.fixture(autouse=True)
def quick_children(monkeypatch):
    monkeypatch.setattr(sandbox, "start", fork_server())


@pytest.mark.parametrize("name", list(READERS))
def test_readers_refuse_damage_in_one_line(name, tmp_path):
    count = share(name, 1200)
    findings = [finding for _, finding in fuzz(name, tmp_path / name, 7, 0, count, 5.0)]
    assert findings == ["begun", None] * count


# What a million inputs have found, one of each kind; (reader, seed, index).
FOUND = (
    ("transforms", 0, 396), ("transforms", 0, 1024), ("transforms", 0, 4009), ("hdr-nerf", 0, 822),
    ("hdr-nerf", 1, 6972), ("scene", 0, 801), ("llff", 0, 98), ("llff", 0, 986), ("exr", 0, 2321), ("photos", 0, 5188),
    ("config", 0, 655), ("run", 0, 295), ("run", 0, 774), ("run", 0, 1867), ("checkpoint", 0, 451), ("resume", 0, 43),
    ("resume", 0, 130), ("resume", 0, 170), ("resume", 0, 249), ("resume", 0, 316), ("resume", 0, 1902),
    ("responses", 0, 100), ("responses", 0, 153), ("responses", 0, 403), ("responses", 0, 413), ("responses", 0, 466),
    ("responses", 0, 534), ("responses", 0, 1409), ("responses", 0, 3020), ("cameras", 0, 5937), ("ply", 19, 3736),
    ("ply", 19, 5257), ("glb", 20, 400), ("glb", 19, 218), ("transforms", 20, 3719), ("usd", 20, 21), ("usd", 20, 27),
    ("usd", 20, 751), ("usd", 20, 1068), ("usd", 20, 4737), ("photos", 31, 9228), ("photos", 30, 2656),
    ("resume", 30, 1091), ("colmap-text", 33, 6037), ("ocio", 1, 11), ("opensfm", 40, 22), ("opensfm", 40, 427),
    ("opensfm", 40, 471), ("opensfm", 40, 652), ("opensfm", 40, 1019), ("opensfm", 40, 1646), ("chan", 40, 795),
    ("dng-opcodes", 41, 34), ("facts", 51, 50),
)  # fmt: skip


@pytest.mark.parametrize("name", sorted({name for name, _, _ in FOUND}))
def test_what_was_found_stays_refused(name, tmp_path):
    space = Workspace(READERS[name], tmp_path / name)
    for _, seed, index in [findings for findings in FOUND if findings[0] == name]:
        make_input(space, name, seed, index)
        assert try_input(space, 5.0) is None, (seed, index)
        space.restore()


def test_mutations_change_files_and_repeat():
    data = b'{"a": [1, 2.5, "x"], "b": {"c": null}}\n' * 3
    mutated = [mutate(data, [data], True, random.Random(seed)) for seed in range(200)]
    assert mutated == [mutate(data, [data], True, random.Random(seed)) for seed in range(200)]
    assert len(set(mutated)) > 120


@pytest.mark.parametrize(
    ("read", "finding"),
    [
        (lambda folder: 1 / 0, "ZeroDivisionError"),
        (lambda folder: _for_ever(), "processor time"),
        (lambda folder: _raise(InputError("p", "x" * 5000, "y" * 5000)), "message of"),
    ],
)
def test_what_a_reader_may_not_do_is_a_finding(read, finding, tmp_path):
    reader = Reader(lambda folder: (folder / "a").write_text("x"), ("a",), read)
    assert finding in try_input(Workspace(reader, tmp_path / "x"), 0.3)


def _for_ever():
    while True:
        pass


def _raise(error):
    raise error
