"""A small share of `python -m tests.fuzz` with a fixed seed, and the tool itself."""

import random
import re

import pytest

from sehdr_warp import sandbox
from sehdr_warp.errors import InputError

from .mutate import misshapen, mutate
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


@pytest.mark.parametrize(
    "name",
    [
        "cameras",
        "cameras-of-others",
        "transforms",
        "hdr-nerf",
        "exposures",
        "opensfm",
        "meshroom",
        "scan",
        "curves",
        "sog",
        "streamed-sog",
    ],
)
def test_values_of_another_shape_are_not_named_in_words_of_python(name, tmp_path):
    workspace, words = Workspace(READERS[name], tmp_path / name), []
    tries = [(path, file) for path, data in workspace.targets.items() if is_json(data) for file in misshapen(data)]
    for path, file in random.Random(3).sample(tries, min(len(tries), 250)):
        path.write_bytes(file)
        workspace.changed = path
        try:
            words += getattr(workspace.read(), "notes", ())
        except InputError as error:
            words.append(str(error))
        path.write_bytes(workspace.whole[path])
        workspace.restore()
    assert len(words) > 40
    assert not [line for line in words if OF_PYTHON.search(line)]


OF_PYTHON = re.compile(
    r"Error\(|object is not|argument must|subscript|has no attribute|could not convert|invalid literal|unpack"
    "|inhomogeneous|reshape|NoneType|indices must|not iterable|unhashable"
)


def is_json(data: bytes) -> bool:
    """Return whether the content of a file is JSON."""
    return data[:1] in (b"{", b"[")


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
