"""The eight scenes by name, as scenes.toml describes them: what stands where, and where the cameras stand."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import SehdrError
from .cameras import Arc, Grid
from .stage import Stage


@dataclass(frozen=True)
class Recipe:
    """A scene as scenes.toml has it, which says what its fields mean."""

    name: str
    title: str
    layout: Grid | Arc
    things: Sequence[list]
    depth: int = 8
    effort: int = 1
    paints: Mapping[str, list] = field(default_factory=dict)

    def build(self, stage: Stage) -> None:
        """Fills a stage."""
        stage.paints = {name: stage.image(*paint) for name, paint in self.paints.items()}
        for thing in self.things:
            _call(stage, thing)


def _call(stage: Stage, step: list):
    """What a method of the stage makes of its arguments, of which lists that begin with a name are such calls too."""
    method, *arguments = step
    options = arguments.pop() if isinstance(step[-1], dict) else {}
    made = (_call(stage, each) if isinstance(each, list) and isinstance(each[0], str) else each for each in arguments)
    return getattr(stage, method)(*made, **options)


def _read() -> dict[str, Recipe]:
    recipes = {}
    for name, stated in tomllib.loads(Path(__file__).with_name("scenes.toml").read_text(encoding="utf-8")).items():
        ((kind, places),) = stated.pop("layout").items()
        recipes[name] = Recipe(name, layout={"grid": Grid, "arc": Arc}[kind](**places), **stated)
    return recipes


RECIPES = _read()


def recipes_named(name: str) -> list[Recipe]:
    """One scene's recipe, or all of them; SehdrError for a name that is not known."""
    if name == "all":
        return list(RECIPES.values())
    if name not in RECIPES:
        raise SehdrError(f"scene {name!r:.40} is not known; take one of {', '.join(RECIPES)}, or all")
    return [RECIPES[name]]
