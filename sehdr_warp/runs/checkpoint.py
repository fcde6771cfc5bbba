"""One checkpoint of a run: tensors, plain values, and the hash that binds them."""

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from ..errors import InputError
from ..files import read_bytes, refuse_links
from .values import CheckpointValues, read_values

TENSORS, VALUES = "state.safetensors", "checkpoint.json"
_OLDER = "remove this folder to use an older checkpoint, or train again"


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as read: its folder, named tensors on the CPU, and plain values."""

    path: Path
    tensors: dict[str, Tensor]
    values: dict[str, Any]


def read_checkpoint(path: Path) -> Checkpoint:
    """Return the checkpoint in a folder.

    Raises:
        InputError: if a file is missing, a link, unreadable, damaged or of another format, or if a tensor holds NaN or
            infinity.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    for file in (path / VALUES, path / TENSORS):
        refuse_links(file, path.parent)
    values, file = read_values(path / VALUES, CheckpointValues, _OLDER), path / TENSORS
    data = read_bytes(file)
    if (digest := hashlib.sha256(data).hexdigest()) != values["sha256"]:
        raise InputError(file, f"its SHA-256 {digest} is not the {values['sha256']:.80} of {VALUES}", _OLDER)
    try:
        tensors = load(data)
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(file, f"is not safetensors ({error})", _OLDER) from None
    if (name := first_not_finite(tensors)) is not None:
        raise InputError(file, f"{name} holds values that are not finite", _OLDER)
    return Checkpoint(path, tensors, values)


def remove_checkpoint(path: Path) -> None:
    """Delete the files of a checkpoint, and its folder if nothing else is in it."""
    with suppress(OSError):
        for name in (VALUES, TENSORS):
            (path / name).unlink(missing_ok=True)
        path.rmdir()


def first_not_finite(tensors: dict[str, Tensor]) -> str | None:
    """Return the name of the first tensor that holds NaN or infinity, None if all numbers are finite."""
    floats = ((name, tensor) for name, tensor in tensors.items() if tensor.is_floating_point())
    return next((name for name, tensor in floats if not bool(tensor.isfinite().all())), None)


def under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors whose names begin with a prefix, under their names without it."""
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
