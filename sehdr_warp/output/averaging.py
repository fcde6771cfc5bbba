"""Pictures that are coarser than the photos of a training, with the light that the photos show."""

from typing import TYPE_CHECKING

from ..scene import Camera

if TYPE_CHECKING:
    from ..runs.run import RenderableScene, RenderedView


def render_averaged(run: "RenderableScene", camera: Camera) -> "RenderedView":
    """Render a view; one that is coarser than the photos is rendered finer and averaged."""
    focals = getattr(getattr(run, "field", None), "photo_focals", None)  # A scene under training states none.
    factor = 1 if focals is None else focals.samples(camera.fx)
    if factor == 1:
        return run.render(camera)
    return run.render(camera.resized(factor * camera.width, factor * camera.height)).reduced(factor)
