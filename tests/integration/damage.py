"""Damage done to a trained run, and what a folder holds."""

import json

from sehdr_warp.runs.run_folder import RunFolder
from tests.make_scenes import edited_json


def snapshot(folder) -> dict:
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def checkpoint_of(run):
    return next((run / "checkpoints").iterdir())


def flip_byte(path, at: int = -5):
    content = bytearray(path.read_bytes())
    content[at] ^= 0x10
    path.write_bytes(content)


def edit_json(path, **fields):
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def edit_view(run, **fields):
    """Change the first view or its camera, and state the file's hash anew, so that the value itself is checked."""
    with edited_json(run / "scene.json") as values:
        for name, value in fields.items():
            (values["views"][0] if name in values["views"][0] else values["views"][0]["camera"])[name] = value
    edit_json(checkpoint_of(run) / "checkpoint.json", run=RunFolder(run).hashes())


def resign(run, change):
    """Changes a checkpoint's tensors and states their hash anew."""
    import hashlib

    from safetensors.torch import load, save

    folder = checkpoint_of(run)
    tensors = load((folder / "state.safetensors").read_bytes())
    change(tensors)
    content = save(tensors)
    (folder / "state.safetensors").write_bytes(content)
    hashes = {"sha256": hashlib.sha256(content).hexdigest(), "run": RunFolder(run).hashes()}
    edit_json(folder / "checkpoint.json", **hashes)


def remove_value(path, name):
    path.write_text(json.dumps({key: value for key, value in json.loads(path.read_text()).items() if key != name}))


def shorten_means(tensors):
    tensors["gaussians.means"] = tensors["gaussians.means"][:3].clone()
