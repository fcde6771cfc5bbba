"""A small share of `python -m tests.fuzz` with a fixed seed, and the tool itself."""

import random

import pytest

from sehdr_warp import sandbox
from sehdr_warp.errors import InputError

from .mutate import mutate
from .reader import Reader, Workspace
from .readers import READERS
from .run import fork_server, fuzz, share, try_input


@pytest.fixture(autouse=True)
def quick_children(monkeypatch):
    monkeypatch.setattr(sandbox, "start", fork_server())


@pytest.mark.parametrize("name", list(READERS))
def test_readers_refuse_damage_in_one_line(name, tmp_path):
    count = share(name, 1200)
    findings = [finding for _, finding in fuzz(name, tmp_path / name, 7, 0, count, 5.0)]
    assert findings == ["begun", None] * count


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
