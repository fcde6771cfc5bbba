"""The HDR truth that some losses need: whether a scene has it, and its largest radiance.

A training refuses missing truth as early as it can: check_dataset_truth() before the photos are read,
check_scene_truth() before points are matched, largest_hdr_truth() in the plan (for fields that the user set) and
before the first step.
"""

from collections.abc import Mapping

from ..errors import InputError
from ..runs.config import Config, LossConfig
from ..runs.values import LoadArguments
from ..scene import Scene

_REMEDY = "take a scene with HDR truth, or a preset that needs none"


def largest_hdr_truth(scene: Scene, loss: LossConfig) -> float:
    """Return the largest radiance in the HDR truth of the training views inside masks; 1.0 if the loss needs none.

    Raises:
        InputError: With scene and field, if truth that the loss needs is missing or black.
    """
    check_scene_truth(scene, loss)
    if not loss.uses_hdr:
        return 1.0
    truths = [(view.hdr, view.mask) for view in scene.train_views if view.hdr is not None]
    values = (hdr if mask is None else hdr[mask > 0] for hdr, mask in truths)
    largest = max((float(radiance.max()) for radiance in values if radiance.size), default=0.0)
    if not largest > 0:
        problem = f"the HDR truth that {_truth_field(loss)} needs is black in every training view"
        raise InputError(scene.name, problem, _REMEDY)
    return largest


def _check_truth(scene: str, has_truth: Mapping[str, bool], loss: LossConfig) -> None:
    """Raise InputError, with scene and field, if training views, by name, lack HDR truth that the loss needs."""
    if not loss.uses_hdr:
        return
    if not any(has_truth.values()):
        problem = f"no training view has the HDR truth that {_truth_field(loss)} needs"
        raise InputError(scene, problem, _REMEDY)
    if loss.ldr_weight == 0 and (lacking := next((name for name in has_truth if not has_truth[name]), None)):
        problem = f"view {lacking} lacks the HDR truth that {_truth_field(loss)} needs where loss.ldr_weight = 0.0"
        raise InputError(scene, problem, _REMEDY)


def _truth_field(loss: LossConfig) -> str:
    """Return the field of the loss that needs HDR truth, with its value."""
    return f"loss.hdr_weight = {loss.hdr_weight}" if loss.hdr_weight > 0 else "loss.hdr_truth = true"


def check_scene_truth(scene: Scene, loss: LossConfig) -> None:
    """Raise InputError if training views of a scene lack HDR truth that the loss needs."""
    _check_truth(scene.name, {view.name: view.hdr is not None for view in scene.train_views}, loss)


def check_dataset_truth(data: LoadArguments, config: Config) -> None:
    """Raise InputError if a dataset lacks HDR truth that the loss needs, before its photos are read.

    `data` names the photos, `config` is the config before the plan.
    """
    from ..scene.file_names import unique_names
    from ..scene.load import parse_dataset

    if not config.loss.uses_hdr or (config.plan.enabled and config.loss.hdr_weight == 0):
        return  # A plan leaves out a linear loss without truth.
    path = data.get("path")
    assert path is not None, "the caller checks the path"
    dataset = parse_dataset(path, exposure_index=data.get("exposure_index"), holdout=data.get("holdout"))
    records = zip(unique_names(dataset.records), dataset.records, strict=True)
    has_truth = {name: record.hdr is not None for name, record in records if record.split == "train"}
    _check_truth(dataset.name, has_truth, config.loss)
