"""Checkpoints: complete or absent, hashed, newest first."""

import json

import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.training.checkpoint import newest_checkpoint, read_checkpoint, write_checkpoint


def state(iteration):
    tensors = {
        "a.b": torch.arange(6.0).reshape(2, 3) + iteration,
        "step": torch.tensor(3.0),
        "rng": torch.arange(4, dtype=torch.uint8),
    }
    return tensors, {"iteration": iteration, "order": [2, 0], "seconds": 1.25}


def test_round_trip(tmp_path):
    tensors, values = state(7)
    path = write_checkpoint(tmp_path / "c", tensors, values, kept=1)
    read = read_checkpoint(path)
    assert {name: value.dtype for name, value in read.tensors.items()} == {
        name: value.dtype for name, value in tensors.items()
    }
    assert all(torch.equal(read.tensors[name], value) for name, value in tensors.items())
    assert {name: read.values[name] for name in values} == values
    assert sorted(p.name for p in path.iterdir()) == ["checkpoint.json", "state.safetensors"]


def test_only_the_newest_are_kept(tmp_path):
    for iteration in (9, 10, 100):
        write_checkpoint(tmp_path, *state(iteration), kept=2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["iteration_00000010", "iteration_00000100"]
    assert newest_checkpoint(tmp_path).values["iteration"] == 100


def test_a_damaged_newest_falls_back(tmp_path):
    for iteration in (1, 2):
        write_checkpoint(tmp_path, *state(iteration), kept=2)
    file = tmp_path / "iteration_00000002" / "state.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    assert newest_checkpoint(tmp_path).values["iteration"] == 1
    with pytest.raises(InputError, match="SHA-256"):
        read_checkpoint(file.parent)
    # Written again, the damaged one is replaced.
    write_checkpoint(tmp_path, *state(2), kept=2)
    assert newest_checkpoint(tmp_path).values["iteration"] == 2


def test_what_a_killed_writer_left_is_no_checkpoint(tmp_path):
    left = tmp_path / ".iteration_00000005.123.tmp"
    left.mkdir(parents=True)
    (left / "state.safetensors").write_bytes(b"half")
    assert newest_checkpoint(tmp_path) is None
    write_checkpoint(tmp_path, *state(6), kept=1)
    assert not left.exists()


@pytest.mark.parametrize("text,words", [("{", "JSON"), ("[]", "JSON object"), ('{"format": 99}', "format = 99")])
def test_bad_values_are_named(tmp_path, text, words):
    path = write_checkpoint(tmp_path, *state(1), kept=1)
    (path / "checkpoint.json").write_text(text)
    with pytest.raises(InputError, match=words):
        newest_checkpoint(tmp_path)


def test_a_wrong_tensor_file_with_a_right_hash_is_refused(tmp_path):
    import hashlib

    path = write_checkpoint(tmp_path, *state(1), kept=1)
    values = json.loads((path / "checkpoint.json").read_text())
    (path / "state.safetensors").write_bytes(b"not safetensors")
    values["sha256"] = hashlib.sha256(b"not safetensors").hexdigest()
    (path / "checkpoint.json").write_text(json.dumps(values))
    with pytest.raises(InputError, match="safetensors"):
        read_checkpoint(path)


def test_a_full_disk_loses_nothing(tmp_path, monkeypatch):
    import errno
    import os

    write_checkpoint(tmp_path, *state(1), kept=1)

    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("sehdr_warp.files.os.fsync", refuse)
    with pytest.raises(SehdrError, match="No space"):
        write_checkpoint(tmp_path, *state(2), kept=1)
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["iteration_00000001"]
    assert newest_checkpoint(tmp_path).values["iteration"] == 1
