"""Checkpoints: a folder with safetensors and JSON, complete or absent, never pickle.

A checkpoint is written beside its final place, flushed to the disk and renamed; its JSON holds the hash of its
tensors. A folder that a killed process left is therefore never mistaken for a checkpoint.
"""

import hashlib
import json
import math
import reprlib
import shutil
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from ..errors import InputError
from ..files import atomic_folder

FORMAT = 2
"""Version of what a run holds; a reader refuses others."""
TENSORS, VALUES = "state.safetensors", "checkpoint.json"


@dataclass(frozen=True)
class Checkpoint:
    """One checkpoint as read: named tensors on the CPU, and plain values."""

    path: Path
    tensors: dict[str, Tensor]
    values: dict


def write_checkpoint(folder: Path, tensors: dict[str, Tensor], values: dict, *, kept: int) -> Path:
    """Writes folder/iteration_<n> from a state with the value "iteration", then deletes all but the newest `kept`.

    Later checkpoints go too: a training that is at n was resumed from an earlier one because they are damaged. Where
    the checkpoint of n exists and is sound it is left alone. Raises SehdrError if the disk refuses; checkpoints that
    exist are untouched then.
    """
    from safetensors.torch import save

    final = folder / f"iteration_{values['iteration']:08d}"
    if not _is_sound(final):
        for leftover in folder.glob(".iteration_*"):
            shutil.rmtree(leftover, ignore_errors=True)
        data = save({name: value.detach().cpu().contiguous() for name, value in tensors.items()})
        stated = values | {"format": FORMAT, "sha256": hashlib.sha256(data).hexdigest()}
        with atomic_folder(final, overwrite=True) as beside:
            (beside / TENSORS).write_bytes(data)
            (beside / VALUES).write_text(json.dumps(stated, indent=1) + "\n", encoding="utf-8")
    folders = _folders(folder)
    place = folders.index(final)
    for other in folders[:place] + folders[place + kept :]:
        shutil.rmtree(other, ignore_errors=True)
    return final


def newest_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest complete checkpoint in a folder, None if there is none; damaged ones, and ones with numbers that are
    not finite, are passed over.

    Raises InputError if checkpoints exist and none of them can be used.
    """
    problem = None
    for path in _folders(folder):
        try:
            return read_checkpoint(path)
        except InputError as error:
            problem = problem or error
    if problem is not None:
        raise problem
    return None


def read_checkpoint(path: Path) -> Checkpoint:
    """One checkpoint; raises InputError if a file is missing, damaged, of another format, or holds NaN or infinity."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    remedy = "remove this folder to use an older checkpoint, or train again"
    try:
        values = json.loads((path / VALUES).read_bytes())
        data = (path / TENSORS).read_bytes()
    except OSError as error:
        raise InputError(error.filename or path, f"cannot be read ({error.strerror})", remedy) from None
    except (ValueError, RecursionError) as error:
        raise InputError(path / VALUES, f"not valid JSON ({error})", remedy) from None
    if not isinstance(values, dict):
        raise InputError(path / VALUES, "is not a JSON object", remedy)
    refuse_format(path / VALUES, values)
    for name, kind in (("iteration", int), ("seconds", int | float)):
        if not isinstance(values.get(name), kind) or not 0 <= values[name] < math.inf:
            raise InputError(path / VALUES, f"{name} = {reprlib.repr(values.get(name))} is not a number from 0", remedy)
    if hashlib.sha256(data).hexdigest() != values.get("sha256"):
        raise InputError(path / TENSORS, f"its SHA-256 is not the {values.get('sha256')} of {VALUES}", remedy)
    try:
        tensors = load(data)
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(path / TENSORS, f"not safetensors ({error})", remedy) from None
    if (name := first_not_finite(tensors)) is not None:
        raise InputError(path / TENSORS, f"{name} holds values that are not finite", remedy)
    return Checkpoint(path, tensors, values)


def refuse_format(path: Path, values: dict) -> None:
    """Raises InputError for values of another format than this version's."""
    found = values.get("format")
    if found == 1:
        raise InputError(path, "was made by version 0.1, whose runs this version does not read", "train again")
    if found != FORMAT:
        raise InputError(path, f"format = {reprlib.repr(found)} is not {FORMAT}", "the run is damaged: train again")


def first_not_finite(tensors: dict[str, Tensor]) -> str | None:
    """The name of the first tensor that holds NaN or infinity, None if all numbers are finite."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            return name
    return None


def _is_sound(path: Path) -> bool:
    if not path.exists():
        return False
    try:
        read_checkpoint(path)
    except InputError:
        return False
    return True


def _folders(folder: Path) -> list[Path]:
    """Checkpoint folders, newest first."""
    return sorted(folder.glob("iteration_*"), reverse=True)
