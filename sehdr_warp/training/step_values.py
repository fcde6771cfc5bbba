"""Values that a training step passes on."""

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from ..rasterizer import HarmonicsGradients, Rendering


@dataclass(frozen=True)
class Gradients:
    """Result of Trainer.compute_gradients, beside the gradients that the parameters hold.

    Attributes:
        loss: Scalar loss of this rank's photo.
        image: [H, W, 3] rendered image that was compared with the photo.
        rendering: Result of the rasterizer, without tensors that nothing reads any more.
        needs_means2d_grad: Whether the strategy accumulates the gradients of the projected means.
        harmonics: Gradients of the harmonics in factored form; None if the parameters hold them.
    """

    loss: Tensor
    image: Tensor
    rendering: Rendering
    needs_means2d_grad: bool
    harmonics: HarmonicsGradients | None


class StepResult(NamedTuple):
    """Loss of a step, mean over the ranks, and the image [H, W, 3] that was compared with this rank's photo."""

    loss: Tensor
    image: Tensor
