"""Checkpoints: complete or absent, hashed, newest first."""

import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.runs.checkpoint import RENDER_TENSORS, read_checkpoint
from sehdr_warp.runs.run_folder import RunFolder
from tests.make_scenes import edited_json

from .conftest import state


def test_round_trip(folder):
    tensors, values = state(7)
    path = folder.write_checkpoint(tensors, values, keep=1)
    read = read_checkpoint(path)
    assert {name: value.dtype for name, value in read.tensors.items()} == {
        name: value.dtype for name, value in tensors.items()
    }
    assert all(torch.equal(read.tensors[name], value) for name, value in tensors.items())
    assert {name: read.values[name] for name in values} == values
    assert sorted(p.name for p in path.iterdir()) == ["checkpoint.json", "state.safetensors"]


def test_a_damaged_newest_falls_back(folder):
    for iteration in (1, 2):
        folder.write_checkpoint(*state(iteration), keep=2)
    file = folder.checkpoints / "iteration_00000002" / "state.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    assert folder.newest_checkpoint().values["iteration"] == 1
    with pytest.raises(InputError, match="SHA-256"):
        read_checkpoint(file.parent)
    # Written again, the damaged one is replaced.
    folder.write_checkpoint(*state(2), keep=2)
    assert folder.newest_checkpoint().values["iteration"] == 2


def test_what_decides_the_picture_is_hashed_with_the_checkpoint(folder):
    for file in (folder.config_file, folder.scene_file, folder.info_file):
        file.write_text('{"a": 1, "data": {"path": "here"}}')
    folder.write_checkpoint(*state(1), keep=1)
    folder.info_file.write_text('{"data": {"path": "moved"}, "a": 1}')
    assert RunFolder(folder.path).newest_checkpoint().values["iteration"] == 1
    for file in (folder.config_file, folder.scene_file, folder.info_file):
        text = file.read_text()
        file.write_text(text.replace("1", "2"))
        with pytest.raises(InputError, match=f"{file.name}: was changed since"):
            RunFolder(folder.path).newest_checkpoint()
        file.write_text(text)


def test_a_wrong_tensor_file_with_a_right_hash_is_refused(folder):
    import hashlib

    path = folder.write_checkpoint(*state(1), keep=1)
    with edited_json(path / "checkpoint.json") as values:
        (path / "state.safetensors").write_bytes(b"not safetensors")
        values["sha256"] = hashlib.sha256(b"not safetensors").hexdigest()
    with pytest.raises(InputError, match="safetensors"):
        read_checkpoint(path)


def test_only_the_parts_that_are_asked_for_are_read_and_checked(folder):
    values = {"gaussians.means": torch.ones(2, 3), "optimizer.means.step": torch.tensor(float("nan"))}
    path = folder.write_checkpoint(values, {"iteration": 1, "seconds": 1.0}, keep=1)
    assert list(read_checkpoint(path, RENDER_TENSORS).tensors) == ["gaussians.means"]
    with pytest.raises(InputError, match=r"optimizer\.means\.step holds values that are not finite"):
        read_checkpoint(path)
