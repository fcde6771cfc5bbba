"""HDR-FLIP (Andersson et al. 2021), where the package flip-evaluator is installed: what an eye sees when it flips
between two HDR images, over all exposures that the truth asks for."""

from collections.abc import Callable

import torch


def load_flip() -> tuple[Callable[[torch.Tensor, torch.Tensor], float] | None, str | None]:
    """(metric, None), or (None, the reason) where the package is not there.

    The metric takes prediction and truth, [H, W, 3] linear radiance with Rec.709 primaries in one unit, and returns the
    mean HDR-FLIP in [0, 1], 0 for equal images, at the tool's own viewing distance of 67 pixels a degree; start and
    stop exposures follow from the truth.
    """
    try:
        import flip_evaluator
    except ImportError:
        return None, "HDR-FLIP needs the package flip-evaluator: pip install sehdr-warp[flip]"

    def distance(prediction: torch.Tensor, truth: torch.Tensor) -> float:
        images = (image.clamp_min(0).float().cpu().contiguous().numpy() for image in (truth, prediction))
        return float(flip_evaluator.evaluate(*images, "HDR", applyMagma=False)[1])

    return distance, None
