"""Evaluate a folder of EXR pictures, of any origin, against a scene's HDR truth."""

import logging
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..errors import InputError
from ..output.images import safe_names
from ..scene import Scene, View
from ..scene.hdr_files import read_hdr
from ..subsets import first_names
from .evaluate import Evaluation

log = logging.getLogger(__name__)


class FolderPredictions:
    """The pictures of a folder as predictions, see evaluate.Predictions."""

    def __init__(self, folder: Path, files: dict[str, Path]):
        """Take the EXR files of a folder by the names of their views."""
        self.files, self.facts = files, {"folder": str(folder)}

    def hdr(self, view: View) -> Tensor:
        """Return the radiance in the view's file, [H, W, 3]."""
        return torch.from_numpy(read_hdr(self.files[view.name]).copy())

    def ldr(self, view: View) -> None:
        """Return None, because a folder of radiance has no simulated photos."""

    def confidence(self, view: View) -> None:
        """Return None, because a folder of radiance does not say how reliable it is."""


@torch.no_grad()
def evaluate_folder(folder: Path | str, truth: Scene, *, lpips_weights: Path | str | None = None) -> dict[str, Any]:
    """Compare pictures of any origin with a scene's HDR truth.

    Args:
        folder: EXR files of scene-linear radiance with Rec.709 primaries, named as the views (`r_0.exr`).
        truth: a scene whose views hold HDR truth. Its test views are compared, or all views with a file if it has none.
        lpips_weights: a folder, as for evaluate().

    Returns:
        The figures of evaluate() without those of photos, and "missing": test views without a file; "extra": files
        that belong to no view; "scale_from": the scale of "aligned" is fitted on the training views that have a file
        ("train"), else on the compared views ("scored"), which favors the folder.

    Raises:
        InputError: for a folder without a file of a compared view.
        SehdrError: for a picture of another size.
    """
    folder = Path(folder)
    files = {file.stem: file for file in sorted(folder.glob("*.exr"))} if folder.is_dir() else {}
    names = [view.name for view in truth.views]
    stems = dict(zip(names, safe_names(names), strict=True))
    pictures = {name: files[stem] for name, stem in stems.items() if stem in files}
    candidates = [view for view in truth.test_views or truth.train_views if view.hdr is not None]
    if not candidates:
        raise InputError(truth.name, "its views hold no HDR truth", "choose a set with truth")
    views = [view for view in candidates if view.name in pictures]
    if not views:
        missing_file = f"holds no {stems[candidates[0].name]}.exr or other picture of a view"
        problem = missing_file if folder.is_dir() else "is not a folder"
        raise InputError(folder, problem, f"name the EXR files as the {len(candidates)} views of {truth.name}")
    missing = [view.name for view in candidates if view.name not in pictures]
    extra = sorted(set(files) - set(stems.values()))
    for what, which in (("views have no file", missing), ("files belong to no view", extra)):
        if which:
            log.warning("%d %s: %s", len(which), what, first_names(which, 5))
    training = [view for view in truth.train_views if view.name in pictures and view.hdr is not None]
    evaluation = Evaluation(FolderPredictions(folder, pictures), truth, "cpu", lpips_weights, views, training or views)
    scale_from = "train" if training else "scored"
    return evaluation.result() | {"missing": missing, "extra": extra, "scale_from": scale_from}
