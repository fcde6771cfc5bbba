"""The scenes by name: what is built, and where the cameras stand."""

from collections.abc import Callable
from dataclasses import dataclass

from ..errors import SehdrError
from . import interiors, outdoors
from .cameras import Arc, Grid
from .stage import Stage


@dataclass(frozen=True)
class Recipe:
    """build: fills a stage. layout: the 35 cameras. depth: longest light path, in surfaces met plus one.

    effort: how many times the samples of an easy scene it takes to come near that scene's noise.
    """

    name: str
    build: Callable[[Stage], None]
    layout: Grid | Arc
    depth: int = 8
    effort: int = 1

    @property
    def title(self) -> str:
        return (self.build.__doc__ or "").strip()


RECIPES = {
    recipe.name: recipe
    for recipe in (
        Recipe("study", interiors.study, interiors.STUDY_VIEWS),
        Recipe("window", interiors.window, interiors.WINDOW_VIEWS, effort=4),
        Recipe("lamps", interiors.lamps, interiors.LAMPS_VIEWS, effort=2),
        Recipe("metal", interiors.metal, interiors.METAL_VIEWS, effort=3),
        Recipe("glass", outdoors.glass, outdoors.GLASS_VIEWS, depth=14, effort=3),
        Recipe("sunlit", outdoors.sunlit, outdoors.SUNLIT_VIEWS, effort=2),
        Recipe("night", outdoors.night, outdoors.NIGHT_VIEWS, effort=2),
        Recipe("overcast", outdoors.overcast, outdoors.OVERCAST_VIEWS),
    )
}


def recipes_named(name: str) -> list[Recipe]:
    """One scene's recipe, or all of them; SehdrError for a name that is not known."""
    if name == "all":
        return list(RECIPES.values())
    if name not in RECIPES:
        raise SehdrError(f"scene {name!r:.40} is not known; take one of {', '.join(RECIPES)}, or all")
    return [RECIPES[name]]
