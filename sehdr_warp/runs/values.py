"""The values in the JSON files of a run, each file with its model: what is read from a run is checked here once.

Somebody else may have made a run, so all of it is checked on reading: types, ranges, lengths. Unknown keys are allowed,
because a later version may write more.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from ..errors import InputError
from ..files import UnreadableError, read_json, read_text, refuse_links
from ..scene.gravity import LEAST_UNIT, MOST_UNIT
from ..scene.images.exif import LONGEST, SHORTEST
from .config_files import field_and_problem

FORMAT = 3  # Version of the run folder's format. A reader refuses others.
ORIENTATION_FILE = "orientation.json"
"""File in a run's folder that keeps an up direction and a scale set for it; they then need no options."""
LIGHT_UNIT_FILE = "light_unit.json"  # File in a run's folder that keeps the unit of its light
REMEDY = "the run is damaged: train again"
_OTHER_VERSION = "train again (train PHOTOS --out THIS_FOLDER --overwrite), or use the version that wrote it"
_SMALL, _LARGE = 16 << 20, 256 << 20
"""Largest file that is read, bytes: of one whose size does not depend on the photos, and of one with a line a photo."""

Count = Annotated[int, Field(ge=0, le=2**53)]
Text = Annotated[str, Field(max_length=4096)]
_Photos = Annotated[int, Field(ge=0, le=1_000_000)]
_Gain = Annotated[float, Field(ge=1e-6, le=1e6)]
_Three = Field(min_length=3, max_length=3)
_Row = Annotated[list[FiniteFloat], _Three]
_Length = Annotated[float, Field(ge=-1e9, le=1e9)]
_Decibels = Annotated[float, Field(ge=-1e4, le=1e4)]
_Seconds = Annotated[float, Field(ge=0, le=1e12)]


class Values(BaseModel):
    """A JSON object of a run: no conversions between types, no NaN or infinity, unknown keys pass."""

    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)


class LoadArguments(TypedDict, total=False):
    """Arguments of load_scene() that a run saves in run.json, so that its photos can be loaded again."""

    path: str | None  # Where the photos are: a folder, a video, or "embedded"; None or left out if that is not known
    exposure_index: int | None  # As in load_scene()
    max_size: int | None  # As in load_scene()
    holdout: int | None  # As in load_scene()
    views: list[str]  # Names of the views to read, if only some are


SCENE_OPTIONS = ("exposure_index", "max_size", "holdout")
"""Names of LoadArguments that are options of the command line; Config.load_options states the other arguments."""


class DataValues(Values):
    """LoadArguments, as run.json holds them."""

    path: Text | None = None
    exposure_index: _Photos | None = None
    max_size: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    holdout: _Photos | None = None
    views: Annotated[list[Text], Field(max_length=1_000_000)] | None = None


class GainValues(Values):
    """Gains of the photos' channels, and coefficients of their vignetting, by the photos' names."""

    gains: dict[str, Annotated[list[_Gain], _Three]]
    falloff: dict[str, Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]]


class NormalizationValues(Values):
    """Center (scene coordinates) and unit of the coordinates that the Gaussians are in."""

    center: Annotated[list[FiniteFloat], _Three]
    unit: Annotated[float, Field(gt=0)]


class UpValues(Values):
    """The up direction that photos and poses show; see scene.gravity.UpDirection."""

    direction: _Row
    source: Text
    unit: Annotated[float, Field(ge=LEAST_UNIT, le=MOST_UNIT)] | None = None


class RunValues(Values):
    """The object in run.json."""

    format: int
    scene: Text
    data: DataValues
    base_time: Annotated[float, Field(ge=SHORTEST, le=LONGEST)]
    response: dict[str, Any]
    normalization: NormalizationValues
    color_matrix: Annotated[list[_Row], _Three] | None = None
    exposure_compensation: GainValues | None = None
    up: UpValues | None = None


class CheckpointValues(Values):
    """Values of checkpoint.json, beside the state of the optimizer."""

    format: int
    iteration: Annotated[int, Field(ge=0, le=10_000_000)]
    seconds: _Seconds
    sha256: str
    run: Annotated[dict[str, str], Field(default_factory=dict)]
    large_scene: bool | None = None
    median_depth: Annotated[FiniteFloat, Field(gt=0)] | None = None


class RegionValues(Values):
    """A region of a photo that the scene does not explain; see model.residual_regions.Region."""

    photo: Text
    column: _Length
    row: _Length
    pixels: Count
    stops: _Decibels
    box: Annotated[list[_Length], Field(min_length=4, max_length=4)]


class UnexplainedValues(Values):
    """Number of regions that are not explained, number of their photos, and the worst regions."""

    regions: Count
    photos: Count
    worst: Annotated[list[RegionValues], Field(max_length=10_000)]


class SummaryValues(Values):
    """Values of summary.json."""

    iteration: Count
    train_seconds: _Seconds
    finished: bool = False
    gaussians: Count = 0
    skipped_steps: Count = 0
    device: Text = ""
    peak_memory_bytes: Count | None = None
    peak_gpu_memory_bytes: Count | None = None
    estimated_light: Annotated[float, Field(ge=0, le=1)] | None = None
    unexplained: UnexplainedValues | None = None
    brightness_offsets: dict[str, _Decibels] | None = None


class DecisionValues(Values):
    """A decision of the plan: fields of the config with their values, the choice in words, and why."""

    name: Text
    choice: Text
    reason: Text
    fields: dict[str, Any]


class PlanValues(Values):
    """Values of plan.json."""

    decisions: Annotated[list[DecisionValues], Field(max_length=1000)]


class MetricsValues(Values):
    """A line of metrics.jsonl: the evaluation of the held-out photos at an iteration."""

    iteration: Annotated[int, Field(ge=0, le=10_000_000)]
    seconds: _Seconds = 0.0
    psnr_ldr: _Decibels | None = None
    psnr_mu: _Decibels | None = None
    gaussians: Count | None = None


class LensValues(Values):
    """Lens of a photo whose camera structure from motion found, and the photo's file name."""

    file: Text
    model: Text
    width: Count
    height: Count
    params: Annotated[list[FiniteFloat], Field(max_length=16)]


class ViewValues(Values):
    """A view of scene.json."""

    name: Text
    split: Literal["train", "test"]
    exposure_time: Annotated[float, Field(gt=0)]
    camera: dict[str, Any]
    photo: Text
    lens: LensValues | None = None


class SceneValues(Values):
    """Values of scene.json."""

    views: Annotated[list[ViewValues], Field(max_length=1_000_000)]
    notes: Annotated[list[Annotated[str, Field(max_length=1_000_000)]], Field(max_length=100_000)]  # Some name photos


def read_values(path: Path, model: type[BaseModel], remedy: str = REMEDY) -> dict[str, Any]:
    """Return the JSON object in a file of a run after checking it against a model.

    Raises:
        InputError: if the file cannot be read, is another version's, or does not fit the model. `remedy` is the advice
            if its content is at fault.
    """
    values = read_object(path, remedy)
    if "format" in model.model_fields and (type(version := values.get("format")) is not int or version != FORMAT):
        writer = f"sehdr-warp {values['version']:.20}" if isinstance(values.get("version"), str) else "another version"
        problem = f"format = {version!r:.60} is of {writer}, and this one reads format {FORMAT}"
        raise InputError(path, problem, _OTHER_VERSION)
    try:
        model.model_validate(values)
    except ValidationError as error:
        raise InputError(path, field_and_problem(error)[1], remedy) from None
    return values


def require_readable(data: Mapping[str, object]) -> None:
    """Raise InputError for arguments of load_scene that a reader of the run would refuse."""
    try:
        DataValues.model_validate(data)
    except ValidationError as error:
        raise InputError("the photos' options", field_and_problem(error)[1], "use a value in its range") from None


def read_object(path: Path, remedy: str = REMEDY) -> dict[str, Any]:
    """Return the JSON object in a file of a run, unchecked; raise InputError as read_values does, and for a link."""
    refuse_links(path, path.parent)
    try:
        return read_json(path, _LARGE if path.name == "scene.json" else _SMALL)
    except UnreadableError:
        raise
    except InputError as error:
        raise InputError(path, error.problem, remedy) from None


def read_metrics_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the lines of metrics.jsonl that are whole; a killed process may leave half of one."""
    refuse_links(path, path.parent)
    for line in read_text(path, _LARGE, errors="replace").splitlines():
        with suppress(ValueError, RecursionError):  # A ValidationError is a ValueError.
            values = json.loads(line)
            MetricsValues.model_validate(values)
            yield values
