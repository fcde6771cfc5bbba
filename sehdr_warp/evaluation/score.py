"""Any folder of EXR pictures against the HDR truth of a set, by the protocols of evaluate()."""

import logging
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError
from ..output.names import safe_names
from ..scene import Scene
from ..scene.hdr_files import read_hdr
from .evaluate import Evaluation

log = logging.getLogger(__name__)


class FolderPictures:
    """EXR files of views, by the views' names; predicts like RunPictures."""

    def __init__(self, folder: Path, files: dict[str, Path]):
        self.files, self.facts = files, {"folder": str(folder)}

    def hdr(self, view):
        return torch.from_numpy(read_hdr(self.files[view.name]).copy())

    def ldr(self, view):
        """A folder of radiance has no simulated photos, nor does it say how sure it is."""

    doubt = ldr


@torch.no_grad()
def score_folder(folder: Path | str, truth: Scene, *, lpips_weights: Path | str | None = None) -> dict[str, Any]:
    """Scores pictures of any origin against a scene's HDR truth.

    Args:
        folder: EXR files of scene-linear radiance with Rec.709 primaries, named as the views (`r_0.exr`).
        truth: a scene whose views hold HDR truth; its test views are scored, or all named ones where it has none.
        lpips_weights: as of evaluate().

    Returns:
        What evaluate() does, without figures of photos; and "missing", test views without a file, "extra", files of no
        view, and "scale_from": the scale of "aligned" is fitted on the training views that have a file ("train"), else
        on the scored views ("scored"), which favors the folder.

    Raises:
        InputError: for a folder without a file of a scored view.
        SehdrError: for a picture of another size.
    """
    folder = Path(folder)
    found = {file.stem: file for file in sorted(folder.glob("*.exr"))} if folder.is_dir() else {}
    known = [view.name for view in truth.views]
    names = dict(zip(known, safe_names(known), strict=True))
    files = {view: found[stem] for view, stem in names.items() if stem in found}
    wanted = [view for view in truth.test_views or truth.train_views if view.hdr is not None]
    if not wanted:
        raise InputError(truth.name, "its views hold no HDR truth", "give a set with truth")
    views = [view for view in wanted if view.name in files]
    if not views:
        missing = f"holds no {names[wanted[0].name]}.exr or other picture of a view"
        fault = missing if folder.is_dir() else "is no folder"
        raise InputError(folder, fault, f"name the EXR files as the {len(wanted)} views of {truth.name}")
    missing = [view.name for view in wanted if view.name not in files]
    extra = sorted(set(found) - set(names.values()))
    for what, which in (("views have no file", missing), ("files are of no view", extra)):
        if which:
            log.warning("%d %s: %s", len(which), what, ", ".join(which[:5]) + (", ..." if len(which) > 5 else ""))
    training = [view for view in truth.train_views if view.name in files and view.hdr is not None]
    evaluation = Evaluation(FolderPictures(folder, files), truth, "cpu", lpips_weights, views, training or views)
    more = {"missing": missing, "extra": extra, "scale_from": "train" if training else "scored"}
    return evaluation.result() | more
