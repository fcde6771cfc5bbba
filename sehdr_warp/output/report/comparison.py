"""One view beside its photo: what a report shows of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...runs.run import RenderableScene
from ...scene import View
from ..cameras.paths import interpolate
from ..images.display import display_gain
from ..light_pictures import photo_for_display, photo_light

_GREY, _DARKEST = 0.3, -12  # Display light at which what photos clip is shown; stops that this may take
_CLIPPED, _BRIGHTER = 0.99, 4 / 3  # Encoded value that counts as clipped; factor that counts as brighter
_LEAST_BRIGHTER = 0.001  # Share of a picture that shows light above white


@dataclass(frozen=True)
class Comparison:
    """A view beside its photo; pictures are [H, W, 3] radiance unless stated."""

    name: str  # Of the view
    photo: np.ndarray  # Encoded values in [0, 1]
    from_photo: np.ndarray  # Radiance that the photo alone gives, its response inverted
    hdr: np.ndarray  # Rendered radiance
    exposure_time: float  # Seconds of the photo
    gain: float  # Of its response, see display_gain
    truth: np.ndarray | None = None  # HDR truth in the scale of `hdr`, if the scene has it
    confidence: np.ndarray | None = None  # [H, W] in [0, 1] of the render, if it was measured
    new: np.ndarray | None = None  # Rendered half-way to the nearest other view, if there is one
    alpha: np.ndarray | None = None  # [H, W] coverage of `hdr`
    new_alpha: np.ndarray | None = None  # [H, W] coverage of `new`

    @property
    def scale(self) -> float:
        """Factor from radiance to display light at the exposure of the photo."""
        return self.exposure_time * self.gain

    @property
    def light_above_white(self) -> float:
        """Share of the values that the photo clips, and that the scene shows brighter than all of the photo's light."""
        return float(((self.photo > _CLIPPED) & (self.hdr > _BRIGHTER * self.from_photo.max())).mean())


def darker_stops(comparisons: Sequence[Comparison]) -> int:
    """Return the stops, from _DARKEST to -1, at which pictures show best what photo and scene hold above white.

    The brightest light that a photo can hold is then a middle grey, and brighter light of the scene stands out from it.
    Scenes with next to no light above white are shown at 0.
    """
    if max(each.light_above_white for each in comparisons) < _LEAST_BRIGHTER:
        return 0
    white = max(float(np.max(each.from_photo)) * each.scale for each in comparisons)
    return int(np.clip(np.floor(np.log2(_GREY / max(white, 1e-9))), _DARKEST, -1))


class FirstPicture(NamedTuple):
    """Stops from the exposure, title and lead with which a report shows photo and scene first."""

    stops: int
    title: str
    lead: str


def first_picture(comparison: Comparison) -> FirstPicture:
    """Return how a report opens: as dark as shows the light above white, or as the photo was taken if there is none."""
    stops = darker_stops([comparison])
    if not stops:
        lead = f"View {comparison.name}, in which the scene shows next to no light above the photo's white."
        return FirstPicture(0, "Photo and scene", lead)
    darker = f"{-stops} stop{'s' * (stops < -1)} darker"
    lead = f"View {comparison.name}, {darker}. What the photo clipped stays flat."
    return FirstPicture(stops, "Light above white", lead)


def compare(run: RenderableScene, view: View, views: Sequence[View], scale: float = 1.0) -> Comparison:
    """Render a view of a run and compare it with its photo.

    Args:
        run: The run.
        view: With photo and truth.
        views: All views of the scene.
        scale: Factor from the run's radiance to that of the truth.
    """
    confidence, render, new = run.render_confidence(view.camera), run.render(view.camera), None
    others = [other.camera for other in views if other.name != view.name]
    if others:
        nearest = min(others, key=lambda camera: float(np.linalg.norm(camera.position - view.camera.position)))
        new = run.render(interpolate([view.camera, nearest], 3)[1])
    return Comparison(
        view.name,
        photo=photo_for_display(run, view),
        from_photo=photo_light(run, view),
        hdr=render.hdr.cpu().numpy(),
        exposure_time=view.exposure_time,
        gain=display_gain(run.response),
        truth=None if view.hdr is None else view.hdr / scale,
        confidence=None if confidence is None else confidence.cpu().numpy(),
        new=None if new is None else new.hdr.cpu().numpy(),
        alpha=render.alpha.cpu().numpy(),
        new_alpha=None if new is None else new.alpha.cpu().numpy(),
    )
