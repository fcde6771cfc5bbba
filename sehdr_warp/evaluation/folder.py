"""Evaluate a folder of EXR pictures, of any origin, against a scene's HDR truth."""

import logging
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError, path_of, require_loaded
from ..scene import Scene
from ..scene.file_names import safe_names
from ..scene.images.hdr_files import read_hdr
from ..subsets import first_names
from .evaluate import Evaluation, Predictions

log = logging.getLogger(__name__)


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
    require_loaded("load_scene", truth)
    folder = path_of(folder, "folder")
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
    predictions = Predictions(
        lambda view: torch.from_numpy(read_hdr(pictures[view.name]).copy()), {"folder": str(folder)}
    )
    evaluation = Evaluation(predictions, truth, "cpu", lpips_weights, views, training or views)
    scale_from = "train" if training else "scored"
    return evaluation.result() | {"missing": missing, "extra": extra, "scale_from": scale_from}
