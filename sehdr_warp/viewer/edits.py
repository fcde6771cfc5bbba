"""Edits of a page: crops with undo, and the up direction and scale that are kept with a run."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..output.splat_edits import SplatEdits
from ..output.world_transform import world_transform, write_orientation

_HIDDEN_LOGIT = -30.0  # Of an opacity below 1/255, which is not drawn


@dataclass
class EditedOpacities:
    """Hides Gaussians of a model by their opacities, so that a preview needs no copy of the scene.

    Attributes:
        original: [N] logits before the first edit; None if nothing is hidden.
    """

    original: Tensor | None = None

    def apply(self, run: Any, edits: SplatEdits | None) -> int:
        """Show what edits leave of a run, or all of it for None; return the number of Gaussians that are shown.

        Raises:
            SehdrError: If nothing is left; the scene then stays as it was.
        """
        logits = run.model.gaussians.opacity_logits
        original = logits.detach().clone() if self.original is None else self.original
        if edits is None:
            stays = np.ones(len(original), bool)
        else:
            means = run.model.gaussians.means.detach().cpu().numpy()
            opacities = torch.sigmoid(original).cpu().numpy()
            stays = edits.mask(opacities, world_transform(run).points(means), run)
        with torch.no_grad():
            logits.copy_(original)
            logits[torch.from_numpy(~stays).to(logits.device)] = _HIDDEN_LOGIT
        self.original = None if edits is None else original
        return int(stays.sum())


def edits_of(request: dict) -> SplatEdits | None:
    """Return the edits that a page asks for; None for none. Raises SehdrError for a region that cannot be."""
    crop, cut = (None if request.get(name) is None else str(request[name]) for name in ("crop", "cut"))
    return SplatEdits(crop=crop, cut=cut) if crop or cut else None


def orient(run: Any, request: dict) -> None:
    """Keep with a run the up direction or the scale that a page sets; raise SehdrError for values that cannot be."""
    up, scale = request.get("up"), request.get("scale")
    write_orientation(
        run,
        up=None if up is None else [float(value) for value in up],
        scale=None if scale is None else float(scale),
    )
