"""The HDR truth that a loss needs: whether a scene, or a dataset before its photos are read, has it."""

from collections.abc import Sequence

from ..errors import InputError
from ..runs.config import Config, LossConfig
from ..runs.load_arguments import LoadArguments
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


def check_hdr_truth(scene: str, views: Sequence[tuple[str, bool]], loss: LossConfig) -> None:
    """Raise InputError, with scene and field, if HDR truth that the loss needs is missing.

    `views` has the name of each training view, and whether it has HDR truth.
    """
    if not loss.uses_hdr:
        return
    if not any(has_truth for _, has_truth in views):
        problem = f"no training view has the HDR truth that {_truth_field(loss)} needs"
        raise InputError(scene, problem, _REMEDY)
    if loss.ldr_weight == 0 and (lacking := next((name for name, has_truth in views if not has_truth), None)):
        problem = f"view {lacking} lacks the HDR truth that {_truth_field(loss)} needs where loss.ldr_weight = 0.0"
        raise InputError(scene, problem, _REMEDY)


def _truth_field(loss: LossConfig) -> str:
    """Return the field of the loss that needs HDR truth, with its value."""
    return f"loss.hdr_weight = {loss.hdr_weight}" if loss.hdr_weight > 0 else "loss.hdr_truth = true"


def check_scene_truth(scene: Scene, loss: LossConfig) -> None:
    """Raise InputError if training views of a scene lack HDR truth that the loss needs."""
    check_hdr_truth(scene.name, [(view.name, view.hdr is not None) for view in scene.train_views], loss)


def check_dataset_truth(data: LoadArguments, config: Config) -> None:
    """Raise InputError if a dataset lacks HDR truth that the loss needs, before its photos are read.

    `data` names the photos, `config` is the config before the plan.
    """
    from ..scene.names import unique_names
    from ..scene.parse import parse_dataset

    # A plan removes the loss between brackets and truth that is missing.
    removed = config.plan.enabled and not config.loss.hdr_weight
    if not config.loss.uses_hdr or removed:
        return
    path = data.get("path")
    assert path is not None, "the caller checks the path"
    dataset = parse_dataset(path, exposure_index=data.get("exposure_index"), holdout=data.get("holdout"))
    records = zip(unique_names(dataset.records), dataset.records, strict=True)
    views = [(name, record.hdr is not None) for name, record in records if record.split == "train"]
    check_hdr_truth(dataset.name, views, config.loss)
