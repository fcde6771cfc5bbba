"""A small share of `python -m tests.fuzz` with a fixed seed, and the tool itself."""

import random

import pytest

from sehdr_warp.errors import InputError

from .mutate import mutate
from .readers import READERS, Reader, Workspace
from .run import fuzz, try_input

# Milliseconds an input: the slow readers get fewer.
INPUTS = {"run": 8, "checkpoint": 8, "resume": 8, "responses": 20, "scene": 20, "photos": 30, "exr": 40}


@pytest.mark.parametrize("name", list(READERS))
def test_readers_refuse_damage_in_one_line(name, tmp_path):
    findings = []

    def report(index, finding):
        if finding not in (None, "begun"):
            findings.append((index, finding))

    assert fuzz(name, tmp_path / name, 7, 0, INPUTS.get(name, 60), 5.0, float("inf"), report) == INPUTS.get(name, 60)
    assert findings == []


def test_mutations_change_files_and_repeat():
    data = b'{"a": [1, 2.5, "x"], "b": {"c": null}}\n' * 3
    made = [mutate(data, [data], True, random.Random(seed)) for seed in range(200)]
    assert made == [mutate(data, [data], True, random.Random(seed)) for seed in range(200)]
    assert len(set(made)) > 120


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
