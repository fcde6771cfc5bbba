"""Results of rendering a radiance field: a training view, a view of the scene, its light along directions."""

from dataclasses import dataclass

from torch import Tensor

from ..rasterizer import Rendering


@dataclass(frozen=True)
class TrainRender:
    """A differentiable render of a training view; images [H, W, 3], None if they were not requested.

    Attributes:
        encoded: Encoded values, extended beyond [0, 1] as by Response.encode_extended.
        exposure: Exposure of the HDR color at the base time (I^h dt_1 in the paper); None for encoded color models.
        base: Exposure of the base color at the base time (I^b); the same tensor as `exposure` without fusion.
        rendering: Result of the rasterizer: alpha, projected means, radii.
        photo_exposure: Exposure of this photo, the input of the response; None if colors are encoded before they are
            composited.
        opacity_penalty: Penalty on the opacities, a scalar; None without a weight.
    """

    encoded: Tensor | None
    exposure: Tensor | None
    base: Tensor | None
    rendering: Rendering
    photo_exposure: Tensor | None = None
    opacity_penalty: Tensor | None = None


@dataclass(frozen=True)
class RenderedView:
    """A rendered view of a trained scene, composited over black.

    Attributes:
        hdr: [H, W, 3] float32 scene-linear radiance, >= 0, not multiplied by an exposure time.
        alpha: [H, W] coverage in [0, 1].
        depth: [H, W] mean distance along the camera's axis if alpha is above 0.001, else 0; scene units.
    """

    hdr: Tensor
    alpha: Tensor
    depth: Tensor


@dataclass(frozen=True)
class DirectionalRender:
    """A rendered environment: a trained scene along directions from one point, composited over black.

    Attributes:
        hdr: [H, W, 3] as in RenderedView.
        alpha: [H, W] as in RenderedView.
        distance: [H, W] mean distance if alpha is above 0.001, else 0; scene units.
        confidence: [H, W] in [0, 1], as from render_confidence; None if it was not measured.
        clipped: [H, W] in [0, 1], the mean of the shares that render_directions() was called with, weighted by light;
            None without shares.
    """

    hdr: Tensor
    alpha: Tensor
    distance: Tensor
    confidence: Tensor | None
    clipped: Tensor | None = None
