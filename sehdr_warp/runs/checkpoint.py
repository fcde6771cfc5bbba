"""One checkpoint of a run: tensors, plain values, and the hash that binds them; and JSON of a run, typed."""

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError
from torch import Tensor

from ..errors import InputError
from ..files import plain_size, read_json
from ..scene.exposure import LONGEST, SHORTEST
from .config_files import field_and_problem

FORMAT = 3  # Version of the run folder; a reader refuses others
TENSORS, VALUES = "state.safetensors", "checkpoint.json"
REMEDY = "the run is damaged: train again"
OTHER_VERSION = "train again (train PHOTOS --out THIS_FOLDER --overwrite), or use the version that wrote it"
_OLDER = "remove this folder to use an older checkpoint, or train again"


_Count = Annotated[int, Field(ge=0, le=1_000_000)]
_Gain = Annotated[float, Field(ge=1e-6, le=1e6)]
_Three = Field(min_length=3, max_length=3)
_Row = Annotated[list[FiniteFloat], _Three]


class Values(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)


class _DataValues(Values):
    path: Annotated[str, Field(max_length=4096)] | None = None
    exposure_index: _Count | None = None
    max_size: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    holdout: _Count | None = None


class _GainValues(Values):
    gains: dict[str, Annotated[list[_Gain], _Three]]
    falloff: dict[str, Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]]


class _NormalizationValues(Values):
    """Center (scene coordinates) and unit of the coordinates that the Gaussians are in."""

    center: Annotated[list[float], _Three]
    unit: Annotated[float, Field(gt=0)]


class RunValues(Values):
    """What run.json holds."""

    scene: str
    data: _DataValues
    base_time: Annotated[float, Field(ge=SHORTEST, le=LONGEST)]
    response: dict
    normalization: _NormalizationValues | None = None
    color_matrix: Annotated[list[_Row], _Three] | None = None
    photo_gains: _GainValues | None = None


class _CheckpointValues(Values):
    iteration: Annotated[int, Field(ge=0, le=10_000_000)]
    seconds: Annotated[float, Field(ge=0)]
    run: Annotated[dict[str, str], Field(default_factory=dict)]


@dataclass(frozen=True)
class Checkpoint:
    """One checkpoint as read: named tensors on the CPU, and plain values."""

    path: Path
    tensors: dict[str, Tensor]
    values: dict


def read_checkpoint(path: Path) -> Checkpoint:
    """One checkpoint; raises InputError if a file is missing, damaged, of another format, or holds NaN or infinity."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    values, file = read_values(path / VALUES, _CheckpointValues, _OLDER), path / TENSORS
    try:
        plain_size(file)
        data = file.read_bytes()
        if hashlib.sha256(data).hexdigest() != values.get("sha256"):
            raise InputError(file, f"its SHA-256 is not the {values.get('sha256')} of {VALUES}", _OLDER)
        tensors = load(data)
    except OSError as error:
        raise InputError(file, f"cannot be read ({error.strerror})", _OLDER) from None
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(file, f"not safetensors ({error})", _OLDER) from None
    if (name := first_not_finite(tensors)) is not None:
        raise InputError(file, f"{name} holds values that are not finite", _OLDER)
    return Checkpoint(path, tensors, values)


def remove_checkpoint(path: Path) -> None:
    """Removes a checkpoint, and its folder where nothing else is in it."""
    with suppress(OSError):
        for name in (VALUES, TENSORS):
            (path / name).unlink(missing_ok=True)
        path.rmdir()


def first_not_finite(tensors: dict[str, Tensor]) -> str | None:
    """The name of the first tensor that holds NaN or infinity, None if all numbers are finite."""
    floats = ((name, tensor) for name, tensor in tensors.items() if tensor.is_floating_point())
    return next((name for name, tensor in floats if not bool(tensor.isfinite().all())), None)


def under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Those whose names begin so, by the rest of their names."""
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


def read_values(path: Path, kind: type[BaseModel], remedy: str = REMEDY) -> dict:
    """The values in a file of this version's format, checked to be of a kind."""
    values = read_run_json(path, remedy)
    if (found := values.get("format")) != FORMAT:
        writer = f"sehdr-warp {values['version']:.20}" if isinstance(values.get("version"), str) else "another version"
        problem = f"format = {found!r:.60} is of {writer}, and this one reads format {FORMAT}"
        raise InputError(path, problem, OTHER_VERSION)
    try:
        kind.model_validate(values)
    except ValidationError as error:
        raise InputError(path, field_and_problem(error)[1], remedy) from None
    return values


def read_run_json(path: Path, remedy: str = REMEDY) -> dict:
    try:
        return read_json(path)
    except InputError as error:
        raise InputError(path, error.problem, remedy) from None
