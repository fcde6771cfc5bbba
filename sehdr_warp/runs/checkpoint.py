"""One checkpoint of a run: tensors, plain values, and the hash that binds them."""

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from ..errors import InputError
from ..files import UnreadableError, plain_size, read_bytes, refuse_links
from .values import CheckpointValues, read_values

TENSORS, VALUES = "state.safetensors", "checkpoint.json"
RENDER_TENSORS = "gaussians.", "fusion.", "response."
"""Beginnings of the names of the tensors that decide the picture; the others continue a training."""
_LARGE = 1 << 28  # Bytes that are hashed in no time
_OLDER = "remove this folder to use an older checkpoint, or train again"


@dataclass(frozen=True)
class Checkpoint:
    """Everything that determines the next step of a training, as named tensors and plain values.

    On the CPU a training that continues from it repeats an uninterrupted one bit for bit. No global random state is
    used.
    """

    tensors: dict[str, Tensor]  # On the CPU if it was read
    values: dict[str, Any]
    path: Path = Path("memory")  # The folder that it was read from


def read_checkpoint(path: Path, parts: tuple[str, ...] = ("",)) -> Checkpoint:
    """Return the checkpoint in a folder, which may be larger than half of the memory.

    Args:
        path: The folder.
        parts: Beginnings of the names of the tensors to read; by default of all.

    Raises:
        InputError: If a file is missing, a link, unreadable, damaged or of another format, or if a tensor that is read
            holds NaN or infinity.
    """
    from safetensors import SafetensorError, safe_open

    for file in (path / VALUES, path / TENSORS):
        refuse_links(file, path.parent)
    values, file = read_values(path / VALUES, CheckpointValues, _OLDER), path / TENSORS
    _check_length(file)
    if (digest := _sha256(file)) != values["sha256"]:
        raise InputError(file, f"its SHA-256 {digest} is not the {values['sha256']:.80} of {VALUES}", _OLDER)
    try:
        with safe_open(str(file), framework="pt") as stored:
            # Copied, because the file is mapped, and may be replaced while the tensors are in use.
            names = stored.keys()
            tensors = {name: stored.get_tensor(name).clone() for name in names if name.startswith(parts)}
    except (SafetensorError, OSError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(file, f"is not safetensors ({error})", _OLDER) from None
    if (name := first_not_finite(tensors)) is not None:
        raise InputError(file, f"{name} holds values that are not finite", _OLDER)
    return Checkpoint(tensors, values, path)


def _check_length(file: Path) -> None:
    """Raise InputError if a large file does not have the length that its header states, before it is read whole."""
    from safetensors import SafetensorError, safe_open

    try:
        if file.is_file() and file.stat().st_size > _LARGE:
            with safe_open(str(file), framework="pt"):
                pass
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise InputError(file, f"is not safetensors ({error})", _OLDER) from None


def _sha256(file: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal; raise InputError as read_bytes() does, but for its size."""
    try:
        if file.exists() and plain_size(file) > 0:
            with open(file, "rb") as stream:
                return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise UnreadableError(file, error) from None
    return hashlib.sha256(read_bytes(file)).hexdigest()  # It refuses what is missing or empty.


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


def part_of(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors whose names begin with a prefix, under their names without it."""
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
