"""The eight scenes by name, as recipes.toml describes them: what stands where, and where the cameras stand."""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sehdr_warp.errors import SehdrError
from sehdr_warp.scene import Camera, look_at

from .stage import Stage

COLUMNS, ROWS = 7, 5
VIEWS = COLUMNS * ROWS  # HDR-NeRF's number of views; the even ones train (18), the odd ones test (17)
Place = tuple[float, float, float]


@dataclass(frozen=True)
class Grid:
    """Parallel cameras on a plane, as HDR-NeRF's synthetic sets have them. center: the middle camera's place; target:
    where it looks; width, height: of the grid, meters."""

    center: Place
    target: Place
    width: float
    height: float
    field_of_view: float = 50.0

    def pose(self, s: float, t: float) -> np.ndarray:
        pose = look_at(self.center, self.target)
        right, down = pose[:2, :3].copy()
        pose[:3, 3] = -pose[:3, :3] @ (self.center + right * self.width * s + down * self.height * t)
        return pose


@dataclass(frozen=True)
class Arc:
    """Cameras on a part of a sphere, all looking at its center, `target`. radius: meters; azimuth: to either side of
    the -y direction; elevation: lowest and highest, degrees."""

    target: Place
    radius: float
    azimuth: float
    elevation: tuple[float, float]
    field_of_view: float = 50.0

    def pose(self, s: float, t: float) -> np.ndarray:
        low, high = self.elevation
        turn, rise = math.radians(2 * self.azimuth * s), math.radians(0.5 * (low + high) - (high - low) * t)
        away = np.array([math.sin(turn) * math.cos(rise), -math.cos(turn) * math.cos(rise), math.sin(rise)])
        return look_at(self.target + self.radius * away, self.target)


def make_cameras(layout: Grid | Arc, width: int, height: int) -> list[Camera]:
    """The 35 cameras of a layout, rows from top to bottom; field_of_view is across the width, degrees."""
    focal = 0.5 * width / math.tan(math.radians(layout.field_of_view) / 2)
    places = [(i / (COLUMNS - 1) - 0.5, j / (ROWS - 1) - 0.5) for j in range(ROWS) for i in range(COLUMNS)]
    return [Camera(width, height, focal, focal, width / 2, height / 2, layout.pose(s, t)) for s, t in places]


def split_of(index: int) -> str:
    return "test" if index % 2 else "train"


@dataclass(frozen=True)
class Recipe:
    """A scene as recipes.toml has it, which says what its fields mean."""

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
    values = (_call(stage, each) if isinstance(each, list) and isinstance(each[0], str) else each for each in arguments)
    return getattr(stage, method)(*values, **options)


def _read() -> dict[str, Recipe]:
    recipes = {}
    for name, fields in tomllib.loads(Path(__file__).with_name("recipes.toml").read_text(encoding="utf-8")).items():
        ((kind, places),) = fields.pop("layout").items()
        recipes[name] = Recipe(name, layout={"grid": Grid, "arc": Arc}[kind](**places), **fields)
    return recipes


RECIPES = _read()


def recipes_named(name: str) -> list[Recipe]:
    """One scene's recipe, or all of them; SehdrError for a name that is not known."""
    if name == "all":
        return list(RECIPES.values())
    if name not in RECIPES:
        raise SehdrError(f"scene {name!r:.40} is not known; take one of {', '.join(RECIPES)}, or all")
    return [RECIPES[name]]
