"""Pictures that are coarser than the photos of a training, with the light that the photos show."""

import math
from typing import TYPE_CHECKING

from ..scene import Camera

if TYPE_CHECKING:
    from ..runs.run import RenderableScene, RenderedView


MOST_PIXELS = 1 << 23  # Of a render that is averaged; a wider view is rendered less fine.


def render_averaged(run: "RenderableScene", camera: Camera) -> "RenderedView":
    """Render a view; one of a pinhole camera that is coarser than the photos is rendered finer and averaged."""
    focals = getattr(getattr(run, "field", None), "photo_focals", None)  # A scene under training states none.
    if focals is None or run.field.antialiased or not camera.is_pinhole:
        return run.render(camera)
    finest = max(1, math.isqrt(MOST_PIXELS // (camera.width * camera.height)))
    factor = min(focals.samples(camera.fx), finest)
    if factor == 1:
        return run.render(camera)
    return run.render(camera.resized(factor * camera.width, factor * camera.height)).reduced(factor)
