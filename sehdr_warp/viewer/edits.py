"""Edits of a page: crops and gains of lights with undo, and the up direction and scale that are kept with a run."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import SehdrError
from ..json_values import number, numbers, text, whole_number
from ..model.lights import Light
from ..output.export.splat_edits import SplatEdits
from ..output.world_transform import world_transform, write_orientation
from ..scene import View
from ..splats.arrays import HARMONIC_0

MOST_GAIN = 20.0  # Largest gain of a light, in stops up or down
_HIDDEN_LOGIT = -30.0  # Of an opacity below 1/255, which is not drawn


@dataclass
class EditedOpacities:
    """Hides Gaussians of a model by their opacities, so that a preview needs no copy of the scene."""

    original: Tensor | None = None  # [N] logits before the first edit; None if nothing is hidden

    @torch.no_grad()
    def apply(self, run: Any, edits: SplatEdits | None) -> int:
        """Show what edits leave of a run, or all of it for None; return the number of Gaussians that are shown.

        Raises SehdrError if nothing is left; the scene then stays as it was.
        """
        logits = run.field.gaussians.opacity_logits
        current = logits.detach().clone()
        original = current if self.original is None else self.original
        logits.copy_(original)  # Views and masks are counted on the whole scene.
        mask = np.ones(len(original), bool)
        if edits is not None:
            means = run.field.normalization.scene_points(run.field.gaussians.means.detach().cpu().numpy())
            opacities = torch.sigmoid(original).cpu().numpy()
            try:
                mask = edits.mask(opacities, world_transform(run).points(means), run)
            except SehdrError:
                logits.copy_(current)
                raise
        logits[torch.from_numpy(~mask).to(logits.device)] = _HIDDEN_LOGIT
        self.original = None if edits is None else original
        return int(mask.sum())


@dataclass
class LightGains:
    """Makes lights of a model brighter or darker by the colors of their Gaussians."""

    original: tuple[Tensor, Tensor] | None = None
    """The harmonics before the first gain: [N, 3] and [N, K, 3]; None without gains."""

    @torch.no_grad()
    def apply(self, run: Any, lights: Sequence[Light], stops: Mapping[int, float]) -> None:
        """Show lights with gains in stops by their index, and all others as they were trained.

        Raises SehdrError for a gain out of range, or a model whose lights cannot be scaled.
        """
        model = run.field
        if model.color_model.display_referred or model.fusion is not None:
            raise SehdrError("gains need radiance without fusion, such as that of the default preset")
        for index, gain in stops.items():
            if not 0 <= index < len(lights):
                raise SehdrError(f"light {index} is not one of the {len(lights)} lights")
            if not abs(gain) <= MOST_GAIN:  # NaN is not.
                raise SehdrError(f"gain {gain} is not between -{MOST_GAIN:g} and {MOST_GAIN:g} stops")
        parts = model.gaussians.harmonics_dc, model.gaussians.harmonics_rest
        original = self.original or tuple(part.detach().clone() for part in parts)
        for part, values in zip(parts, original, strict=True):
            part.copy_(values)
        for index, gain in stops.items():
            members = lights[index].members.to(parts[0].device)
            if model.color_model.name == "log":
                parts[0][members] += gain * math.log(2) / HARMONIC_0
            else:
                for part in parts:
                    part[members] *= 2.0**gain
        self.original = original if stops else None


def edits_of(request: dict, photos: Callable[[], Sequence[View]]) -> SplatEdits | None:
    """Return the edits of a request: any of "crop", "cut", "min_opacity", "min_views" and "mask_only"; None for none.

    photos: returns the photos with their masks, for "mask_only". Raises SehdrError for a value that cannot be, or masks
    that are not there, and ValueError for one of another type.
    """
    kinds = {"crop": text, "cut": text, "min_opacity": number, "min_views": whole_number}
    edits: dict[str, Any] = {name: read(request, name) for name, read in kinds.items() if request.get(name) is not None}
    if request.get("mask_only"):
        edits["mask_views"] = photos()
    return SplatEdits(**edits) if edits else None


def history_of(request: dict) -> list[dict]:
    """Return the edits that a page can undo, the newest last; raise SehdrError for values that no page draws."""
    history = request.get("history", [{}])
    if not (isinstance(history, list) and history and all(isinstance(edits, dict) for edits in history)):
        raise SehdrError("history is not a list of edits")
    for name, value in (item for edits in history for item in edits.items()):
        if isinstance(value, dict):
            points = np.array(value.get("points"), np.float64)
            is_edit = value.get("shape") in ("sphere", "box") and points.shape == (2, 3) and np.isfinite(points).all()
        else:
            numbers = value if isinstance(value, list) else [value]
            is_edit = all(isinstance(number, int | float) for number in numbers)
        if not is_edit:
            raise SehdrError(f"history: {name:.40} is not an edit")
    return history


def orient(run: Any, request: dict) -> None:
    """Keep with a run the up direction or the scale that a page sets; raise SehdrError for values that cannot be."""
    write_orientation(
        run,
        up=None if request.get("up") is None else numbers(request, "up", -1).tolist(),
        scale=None if request.get("scale") is None else number(request, "scale"),
    )
