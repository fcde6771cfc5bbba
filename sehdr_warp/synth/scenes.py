"""The eight scenes by name: what stands where, and where the cameras stand."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import SehdrError
from . import textures
from .cameras import Arc, Grid
from .stage import Stage, lathe
from .textures import brick, checker, fabric, facade, globe, ground, outside, painting, plaster, wallpaper, wood


@dataclass(frozen=True)
class Recipe:
    """build: fills a stage. layout: the 35 cameras. depth: longest light path, in surfaces met plus one.

    effort: how many times the samples of an easy scene it takes to come near that scene's noise.
    """

    build: Callable[[Stage], None]
    layout: Grid | Arc
    depth: int = 8
    effort: int = 1

    @property
    def name(self) -> str:
        return self.build.__name__

    @property
    def title(self) -> str:
        return (self.build.__doc__ or "").strip()


RECIPES: dict[str, Recipe] = {}


def recipe(layout: Grid | Arc, **options):
    """Makes a function that fills a stage the recipe of its name."""

    def note(build):
        RECIPES[build.__name__] = Recipe(build, layout, **options)
        return build

    return note


def recipes_named(name: str) -> list[Recipe]:
    """One scene's recipe, or all of them; SehdrError for a name that is not known."""
    if name == "all":
        return list(RECIPES.values())
    if name not in RECIPES:
        raise SehdrError(f"scene {name!r:.40} is not known; take one of {', '.join(RECIPES)}, or all")
    return [RECIPES[name]]


@recipe(Arc((0.0, 0.75, 1.0), 3.25, 34.0, (-3.0, 17.0)))
def study(s: Stage) -> None:
    """A furnished room under a ceiling panel and daylight from the side; at most a corner of the panel is in view."""
    walls = [
        s.varnished(wood, rough=0.3, repeat=(1, 1.2)),
        s.matt(brick, 6, 4, (0.5, 0.5, 0.48), (0.68, 0.67, 0.64), (0.2, 0.2, 0.2)),
        s.matt(wallpaper, stripe=(0.30, 0.17, 0.14), dot=(0.10, 0.16, 0.40), repeat=(1.6, 1)),
        s.matt(wallpaper, repeat=(1.6, 1)),
        s.matt(plaster),
        s.matt(brick, 14, 9, (0.30, 0.24, 0.18), (0.62, 0.54, 0.42)),
    ]
    s.room(2.7, -3.3, 2.2, 2.7, walls)
    s.bright_panel([0, 0.0, 2.68], [0.9, 0, 0], [0, -0.55, 0], (13.0, 12.0, 10.5), 3)
    s.bright_panel([-2.68, -1.9, 1.5], [0, 0.7, 0], [0, 0, 0.6], (16.0, 19.0, 24.0), 2)
    s.rug(0.1, -0.2, 1.2, 0.85, (0.35, 0.05, 0.05), (0.60, 0.48, 0.30), (2, 1.5))
    top = s.table((0.1, 0.55), (0.8, 0.45))
    s.ball([-0.35, 0.45, top + 0.17], 0.17, s.varnished(globe, rough=0.15), 40, 20)
    for z, half, dark, light, turn in (
        (0.09, (0.10, 0.09, 0.09), (0.45, 0.06, 0.04), (0.75, 0.70, 0.25), 25),
        (0.23, (0.07, 0.06, 0.05), (0.03, 0.12, 0.35), (0.60, 0.65, 0.70), -15),
    ):
        s.box([0.45, 0.35, top + z], half, s.varnished(checker, 4, dark, light, rough=0.25), turn)
    s.vase([0.72, 0.72, top], s.varnished(painting, 80, rough=0.15, repeat=(2, 1)))
    s.plant([0.72, 0.72, top + 0.38])
    s.knot([0.05, 0.30, top + 0.135], s.varnished(fabric, (0.5, 0.2, 0.02), (0.7, 0.5, 0.1), repeat=(8, 1)))
    s.shelf((-1.45, 1.98), 0.6, 0.20, 4)
    s.armchair((1.65, 0.45), -28)
    s.crate((-1.4, 0.6, 0.0), 0.28)
    s.picture([0.15, 2.16, 1.75], 0.45, 0.32)
    s.picture([1.55, 2.16, 1.65], 0.32, 0.42, 90)
    s.picture([2.66, 0.9, 1.6], [0, -0.5, 0], 0.38, 60)
    cube = s.varnished(checker, 5, (0.06, 0.22, 0.12), (0.6, 0.6, 0.5), rough=0.25)
    s.box([-1.9, -0.5, 0.22], [0.22, 0.22, 0.22], cube, 18)


@recipe(Grid((0.0, -2.6, 1.35), (0.15, 2.0, 1.15), 1.05, 0.5, 52.0), effort=4)
def window(s: Stage) -> None:
    """A dim room lit by a window that shows a bright street; one dark corner."""
    back, half, height, hole = 2.2, 2.4, 2.7, (0.25, 1.75, 0.95, 2.2)
    walls = [
        s.varnished(wood, 8, rough=0.28, repeat=(1, 1.2)),
        s.matt(wood, 6, (0.4, 0.36, 0.3), (0.6, 0.56, 0.5), repeat=(1, 2)),
        s.matt(painting, 120, 512, gain=0.5, lift=0.2, repeat=(1.5, 1)),
        s.matt(wallpaper, repeat=(1.6, 1)),
        s.matt(plaster),
    ]
    s.room(half, -3.3, back, height, walls)
    s.wall_with_hole(back, half, height, hole, brick(s.rng), (1.6, 1))
    s.window_frame(back, hole, s.varnished(wood, 3, (0.5, 0.47, 0.4), (0.75, 0.72, 0.66)))
    # Near behind the window, so that light drawn from it enters the room.
    s.bright_panel([1.0, back + 0.4, 1.58], [1.0, 0, 0], [0, 0, 0.85], outside(s.rng) * 60.0)
    top = s.table((0.35, 0.6), (0.75, 0.42))
    s.ball([0.05, 0.5, top + 0.16], 0.16, s.varnished(globe, rough=0.15), 120, 20)
    cube = s.varnished(checker, 4, (0.4, 0.05, 0.04), (0.75, 0.7, 0.3), rough=0.25)
    s.box([0.62, 0.38, top + 0.09], [0.09, 0.09, 0.09], cube, 30)
    s.vase([0.85, 0.75, top], s.varnished(painting, 60, rough=0.15, repeat=(2, 1)), 0.36)
    s.plant([0.85, 0.75, top + 0.33], 9, 0.25)
    s.shelf((-1.2, 1.98), 0.6, 0.20, 5)
    s.armchair((-0.65, 0.9), 30)
    s.crate((-1.55, 0.5, 0.0), 0.3)
    s.crate((1.5, 0.2, 0.0), 0.25)
    s.picture([-0.25, back - 0.04, 1.75], 0.28, 0.34, 50, "Cu")
    s.picture([half - 0.02, 0.9, 1.6], [0, -0.5, 0], 0.36, 60)
    s.rug(0.0, -0.3, 1.1, 0.7, (0.06, 0.10, 0.30), (0.60, 0.52, 0.38), (2, 1.4))


@recipe(Arc((0.0, 0.8, 1.05), 3.2, 32.0, (-2.0, 18.0), field_of_view=54.0), effort=2)
def lamps(s: Stage) -> None:
    """An evening room whose lamps are in view: bulbs, a shaded lamp, a neon tube, a candle-like row, one red light."""
    walls = [
        s.varnished(checker, 10, (0.10, 0.05, 0.03), (0.55, 0.48, 0.38), rough=0.3),
        s.matt(wood, 7, (0.2, 0.13, 0.08), (0.4, 0.3, 0.2), repeat=(1, 2)),
        s.matt(brick, 16, 8, (0.2, 0.22, 0.25), (0.45, 0.46, 0.48)),
        s.matt(brick),
        s.matt(plaster),
        s.matt(wallpaper, (0.36, 0.30, 0.34), (0.16, 0.20, 0.30), (0.6, 0.45, 0.12), repeat=(1.8, 1)),
    ]
    s.room(2.6, -3.2, 2.3, 2.8, walls)
    steel, dark = s.metal("Cr", 0.3), s.matt((0.05, 0.05, 0.05))
    # Three hanging bulbs of different strength and color, in front of the back wall.
    for x, y, z, radius, radiance, weight in (
        (-0.55, 0.9, 1.95, 0.05, (420.0, 290.0, 150.0), 5),
        (0.15, 0.6, 2.1, 0.05, (160.0, 185.0, 220.0), 4),
        (0.95, 1.1, 1.9, 0.06, (90.0, 52.0, 22.0), 3),
    ):
        s.lamp([x, y, z], radius, radiance, weight)
        s.rod([x, y, z + radius], [x, y, 2.8], 0.008, dark)
    # A floor lamp: the bulb shows below its shade from low viewpoints.
    s.lamp([1.75, 1.5, 1.5], 0.06, (300.0, 215.0, 120.0), 4)
    s.rod([1.75, 1.5, 0], [1.75, 1.5, 1.44], 0.018, steel)
    s.drum([1.75, 1.5, 0], 0.16, 0.03, steel)
    shade = lathe([[0.16, 0.20], [0.24, 0.08], [0.32, -0.04]])
    s.surface(shade, 64, 30, [1.75, 1.5, 1.5], s.matt(fabric, (0.3, 0.2, 0.1), (0.6, 0.5, 0.3)))
    # A neon tube on the back wall and a red light on the shelf: saturated colors.
    s.tube([-0.1, 2.24, 2.35], [1.1, 2.24, 2.35], 0.018, (6.0, 26.0, 60.0), 2)
    s.lamp([-1.15, 1.85, 1.85], 0.025, (70.0, 2.0, 1.0), 0.5)
    top = s.table((0.1, 0.6), (0.8, 0.42))
    for k in range(4):
        x = -0.5 + 0.4 * k
        s.drum([x, 0.9, top], 0.03, 0.12, s.matt(fabric, (0.5, 0.4, 0.3), (0.8, 0.75, 0.6), 64))
        s.lamp([x, 0.9, top + 0.15], 0.018, (260.0, 130.0, 40.0), 1)
    s.ball([-0.3, 0.4, top + 0.15], 0.15, s.varnished(globe), 200, 20)
    s.knot([0.15, 0.35, top + 0.135], s.metal("Au", 0.25))
    s.vase([0.6, 0.45, top], s.varnished(painting, 70, repeat=(2, 1)), 0.34)
    s.shelf((-1.35, 2.05), 0.6, 0.20, 4)
    s.armchair((-1.5, 0.6), 35)
    s.crate((1.35, 0.45, 0.0), 0.3)
    s.picture([-0.1, 2.26, 1.6], 0.4, 0.3, 60)
    s.picture([-2.57, 0.9, 1.6], [0, 0.5, 0], 0.36, 60)
    s.rug(0.1, -0.4, 1.2, 0.75, (0.04, 0.2, 0.16), (0.55, 0.5, 0.3), (2, 1.4))


@recipe(Grid((0.0, -1.15, 1.5), (0.0, 0.6, 0.87), 0.6, 0.3, 48.0), effort=3)
def metal(s: Stage) -> None:
    """A still life of polished metals and lacquer under two soft boxes and three small spots: sharp highlights."""
    walls = [
        s.matt(brick, 8, 8, (0.25, 0.2, 0.18), (0.5, 0.42, 0.36)),
        s.matt(checker, 6, (0.1, 0.1, 0.11), (0.3, 0.3, 0.32)),
        s.matt(painting, 90, 512),
        s.matt(wallpaper, (0.5, 0.3, 0.2), (0.2, 0.1, 0.1), (0.6, 0.55, 0.2), repeat=(1.5, 1)),
        s.matt(brick),
        s.matt(brick, 22, 9, (0.08, 0.12, 0.16), (0.24, 0.32, 0.38), (0.4, 0.4, 0.38)),
    ]
    s.room(2.4, -2.8, 2.0, 2.8, walls)
    s.bright_panel([-1.5, -0.6, 2.5], [0.45, 0.2, 0], [0.15, -0.35, 0.3], (30.0, 28.0, 25.0), 4)
    s.bright_panel([1.7, 0.2, 2.2], [0.0, 0.35, 0.0], [-0.2, 0.0, -0.35], (14.0, 18.0, 26.0), 2)
    for x, y in ((-0.5, -0.3), (0.35, 0.0), (0.1, 1.2)):
        s.lamp([x, y, 2.6], 0.06, (420.0, 370.0, 300.0), 1.5)
    top = s.table((0.0, 0.75), (1.15, 0.75), 0.74)
    s.box([0, 0.75, top + 0.005], [0.95, 0.6, 0.005], s.matt(fabric, (0.30, 0.04, 0.06), (0.62, 0.55, 0.42)))
    top += 0.01
    pot = lathe([[0.001, 0], [0.10, 0.0], [0.16, 0.08], [0.15, 0.2], [0.09, 0.27], [0.06, 0.33], [0.08, 0.36]])
    outer, inner = [[0.001, 0.02], [0.07, 0.0], [0.07, 0.03], [0.16, 0.1], [0.22, 0.19]], [[0.21, 0.19], [0.15, 0.1]]
    bowl = lathe([*outer, *inner, [0.001, 0.05]])
    for form, x, y, name, rough in (
        (pot, -0.5, 0.95, "Cu", 0.12),
        (pot, 0.62, 1.1, "Ag", 0.1),
        (bowl, 0.1, 0.55, "Au", 0.14),
    ):
        s.surface(form, 64, 96, [x, y, top], s.metal(name, rough))
    s.knot([-0.32, 0.42, top + 0.14], s.metal("Cr", 0.12), 65, 20)
    s.ball([0.5, 0.55, top + 0.12], 0.12, s.metal("Al", 0.1))
    for x, y, radius, dark, light in (
        (-0.72, 0.5, 0.07, (0.5, 0.03, 0.02), (0.7, 0.5, 0.1)),
        (0.78, 0.7, 0.08, (0.02, 0.2, 0.4), (0.5, 0.6, 0.6)),
    ):
        s.ball([x, y, top + radius], radius, s.varnished(fabric, dark, light, rough=0.1, repeat=(2, 1)))
    for k in range(6):
        x, y = 0.1 + 0.07 * np.cos(0.9 * k), 0.55 + 0.07 * np.sin(0.9 * k)
        s.ball([x, y, top + 0.12 + 0.015 * k], 0.045, s.varnished(painting, 20, 128, rough=0.12))
    for k in range(5):
        coin, high = s.metal(("Au", "Cu", "Ag")[k % 3], 0.18), 0.012 + 0.02 * s.rng.random()
        s.drum([-0.1 + 0.09 * k, 0.22 + 0.02 * (k % 2), top], 0.035, high, coin)
    s.drum([0.02, 1.15, top], 0.1, 0.34, s.metal("W"))
    s.box([-0.12, 1.2, top + 0.1], [0.05, 0.05, 0.1], s.varnished(checker, 4, rough=0.12), 30)
    for x in (-1.3, 0.1, 1.4):
        s.picture([x, 1.97, 1.75], 0.42, 0.32, 50, "Cu")


@recipe(Arc((0.0, 0.45, 0.95), 1.9, 30.0, (3.0, 24.0), field_of_view=46.0), depth=14, effort=3)
def glass(s: Stage) -> None:
    """Clear and tinted glass and a basin of water on a table before a bright, patterned screen."""
    walls = [
        s.matt(wood, 8),
        s.matt(brick, 8, 6, (0.4, 0.4, 0.4), (0.6, 0.6, 0.6)),
        s.matt(brick, 14, 7, repeat=(1.4, 1)),
        s.matt(wallpaper, (0.3, 0.42, 0.4), (0.12, 0.22, 0.3), (0.55, 0.3, 0.1), repeat=(1.5, 1)),
        s.matt(plaster),
        s.matt(brick, 20, 9, (0.16, 0.10, 0.08), (0.42, 0.30, 0.24)),
    ]
    s.room(2.4, -2.4, 1.9, 2.8, walls)
    # All lights are large: what glass bends is found by chance, and a large light is found often.
    s.bright_panel([-0.35, 1.86, 1.35], [0.6, 0, 0], [0, 0, 0.45], painting(s.rng, 30) ** 1.3 * 45.0 + 1.0, 3)
    s.bright_panel([0, 0.2, 2.78], [0.9, 0, 0], [0, -0.8, 0], (9.0, 9.5, 10.0), 3)
    s.bright_panel([2.38, 0.2, 1.7], [0, -0.6, 0], [0, 0, 0.5], (16.0, 12.0, 8.0), 2)
    top = s.table((0.0, 0.55), (1.0, 0.6), 0.72)
    s.box([0, 0.55, top + 0.003], [0.98, 0.58, 0.003], s.matt(checker, 12, (0.08, 0.1, 0.16), (0.7, 0.68, 0.6)))
    top += 0.008
    clear, green, amber = s.glass(), s.glass(tint=(0.72, 0.93, 0.80)), s.glass(tint=(0.95, 0.75, 0.42))
    for x, y, radius, body in ((-0.38, 0.3, 0.15, clear), (0.32, 0.18, 0.09, amber), (0.02, 0.12, 0.06, green)):
        s.ball([x, y, top + radius], radius, body)
    outer = [[0.001, 0], [0.09, 0.002], [0.09, 0.012], [0.015, 0.03], [0.013, 0.14], [0.06, 0.2], [0.09, 0.3]]
    inner = [[0.075, 0.4], [0.068, 0.398], [0.08, 0.3], [0.05, 0.215], [0.001, 0.19]]
    s.surface(lathe(outer + inner), 72, 140, [0.05, 0.42, top], clear)
    body, neck = [[0.001, 0], [0.085, 0.003], [0.09, 0.04], [0.09, 0.22]], [[0.04, 0.32], [0.03, 0.42], [0.034, 0.43]]
    bottle = lathe([*body, *neck, [0.001, 0.432]])
    s.surface(bottle, 72, 120, [-0.1, 0.82, top], green)
    s.surface(bottle, 72, 120, [-0.62, 0.75, top], amber)
    # Water stands free, as a block with pebbles and a striped reed in it; glass around it would show little more.
    s.box([0.55, 0.62, top + 0.13], [0.24, 0.18, 0.125], s.glass(1.33, (0.93, 0.97, 0.99)))
    for _ in range(14):
        radius, x, y = s.rng.uniform(0.02, 0.045), s.rng.uniform(-0.18, 0.18), s.rng.uniform(-0.12, 0.12)
        s.ball([0.55 + x, 0.62 + y, top + 0.01 + radius], radius, s.matt(painting, 8, 64))
    reed = s.matt(checker, 16, (0.5, 0.05, 0.04), (0.8, 0.78, 0.7), repeat=(0.1, 2))
    s.rod([0.45, 0.6, top + 0.02], [0.68, 0.66, top + 0.5], 0.012, reed)
    s.ball([-0.3, 0.55, top + 0.07], 0.07, s.varnished(globe))
    cube = s.varnished(checker, 4, (0.4, 0.05, 0.05), (0.7, 0.65, 0.3), rough=0.25)
    s.box([-0.85, 0.4, top + 0.06], [0.06, 0.06, 0.06], cube, 20)
    s.vase([0.86, 0.3, top], s.varnished(painting, 60, repeat=(2, 1)), 0.3)
    s.picture([0.95, 1.87, 1.45], 0.38, 0.42, 50)
    s.shelf((-1.7, 1.68), 0.5, 0.18, 4)


@recipe(Arc((0.0, 1.5, 1.1), 5.2, 32.0, (3.0, 20.0), field_of_view=52.0), effort=2)
def sunlit(s: Stage) -> None:
    """A court in hard afternoon sun: hot stone and metal, deep shadow under an arcade, an open dark door."""
    stone = brick(s.rng, 14, 8, (0.42, 0.36, 0.28), (0.68, 0.60, 0.48), (0.3, 0.27, 0.22))
    s.sky(textures.sky(s.rng, (0.35, 0.62, 1.35), (1.3, 1.5, 1.7), 2.0, (0.5, 0.45, 0.38)), 1)
    # From behind and to the left of the cameras, 42 degrees high.
    sun = np.array([0.62, 0.52, -0.73])
    s.sun(sun / np.linalg.norm(sun), (30.0, 27.0, 22.0), 2)
    s.panel([0, 2, 0], [9, 0, 0], [0, 9, 0], s.matt(brick, 24, 24, (0.3, 0.27, 0.24), (0.52, 0.48, 0.42)))
    # The house: a front with a dark door, and a roof over an arcade to the right.
    s.wall_with_hole(3.4, 4.5, 3.4, (-1.55, -0.35, 0.0, 2.1), stone, (2.0, 1.0))
    s.panel([-0.85, 5.4, 1.0], [0.9, 0, 0], [0, 0, 1.1], s.matt(painting, 30, gain=0.12))
    for side in (-1, 1):
        s.panel([-0.85 + 0.9 * side, 4.4, 1.0], [0, -side, 0], [0, 0, 1.1], s.matt(wallpaper, gain=0.12))
    s.panel([-0.85, 4.4, 2.1], [0.9, 0, 0], [0, -1.0, 0], s.matt((0.05, 0.04, 0.03)))
    s.panel([-0.85, 4.4, 0.01], [0.9, 0, 0], [0, 1.0, 0], s.matt(checker, 6, gain=0.2))
    tiles = s.matt(brick, 10, 10, (0.35, 0.12, 0.07), (0.6, 0.26, 0.16), (0.15, 0.06, 0.04), repeat=(2, 1))
    s.panel([2.1, 2.5, 2.35], [2.0, 0, 0], [0, 0.95, 0.12], tiles)
    s.panel([2.1, 2.5, 2.33], [2.0, 0, 0], [0, -0.95, -0.12], s.matt(wood, 12))
    for k in range(4):
        s.drum([0.35 + 1.15 * k, 1.75, 0], 0.11, 2.25, s.matt(brick, 12, 4, (0.45, 0.4, 0.33), (0.66, 0.6, 0.5)))
    for x, turn in ((1.0, 10), (2.4, -15)):
        s.drum([x, 2.7, 0], 0.3, 0.8, s.matt(wood, 9))
        s.box([x + 0.55, 2.9, 0.2], [0.2, 0.2, 0.2], s.matt(checker, 4, (0.2, 0.1, 0.05), (0.5, 0.4, 0.25)), turn)
    s.box([-2.6, 3.3, 2.0], [0.45, 0.12, 0.6], s.varnished(wood, 5, (0.03, 0.12, 0.10), (0.10, 0.32, 0.26), rough=0.3))
    for x in (0.6, 2.0, 3.2):
        s.picture([x, 3.37, 2.75], 0.35, 0.3, 20, "Cu")
    # Things in the sun.
    s.drum([-2.2, 1.2, 0], 0.55, 0.35, s.matt(stone, repeat=(2, 0.4)))
    s.plant([-2.2, 1.2, 0.35], 18, 0.75)
    s.drum([-0.3, 0.7, 0], 0.3, 0.75, s.matt(wood, 10, (0.3, 0.2, 0.1), (0.6, 0.45, 0.28)))
    s.ball([-0.3, 0.7, 1.02], 0.27, s.metal("Au", 0.08))
    s.box([0.75, 0.5, 0.3], [0.3, 0.3, 0.3], s.matt(painting, 30), 25)
    s.ball([0.75, 0.5, 0.82], 0.22, s.varnished(globe, rough=0.15), 100, 20)
    s.crate((-1.2, 1.6, 0.0), 0.35)
    s.knot([1.55, 0.9, 0.16], s.metal("Cu", 0.1), 0)
    s.box([2.1, 0.6, 0.22], [0.6, 0.2, 0.22], s.matt(brick, 5, 6), -20)
    s.box([-3.6, 2.2, 0.9], [0.5, 0.9, 0.9], s.matt(brick, 12, 8), 8)


@recipe(Grid((0.0, -4.2, 1.7), (0.0, 3.0, 1.6), 1.3, 0.6, 54.0), effort=2)
def night(s: Stage) -> None:
    """A narrow street under a moonless sky: lanterns, lit windows, a sign, a shop; near black between them."""
    s.sky(textures.sky(s.rng, (0.0006, 0.0008, 0.0016), (0.0025, 0.0022, 0.002), 0.6, (0.0, 0.0, 0.0)), 0.3)
    cobbles = brick(s.rng, 26, 22, (0.10, 0.10, 0.11), (0.34, 0.33, 0.32), (0.04, 0.04, 0.04))
    s.panel([0, 4, 0], [3.2, 0, 0], [0, 10, 0], s.varnished(cobbles, rough=0.35, repeat=(2, 6)))
    left = s.matt(brick, 22, 22, (0.22, 0.10, 0.07), (0.48, 0.26, 0.18), repeat=(2, 1.6))
    right = s.matt(brick, 18, 20, (0.26, 0.25, 0.22), (0.5, 0.48, 0.42), repeat=(2, 1.6))
    s.panel([-2.6, 4, 5.0], [0, 9, 0], [0, 0, 5.0], left)
    s.panel([2.6, 4, 5.0], [0, -9, 0], [0, 0, 5.0], right)
    s.panel([0, 9.0, 4.2], [2.6, 0, 0], [0, 0, 4.2], s.matt(brick, 16, 12, (0.2, 0.2, 0.24), (0.4, 0.4, 0.44)))
    # Windows: a few rows glow, each pane with its own strength.
    warm, cold = (1.0, 0.60, 0.26), (0.5, 0.75, 1.0)
    for x, y, z, tint, strength, weight in (
        (-2.58, 1.4, 2.7, warm, 5.0, 2),
        (-2.58, 4.6, 2.5, cold, 1.2, 1),
        (2.58, 3.2, 2.9, warm, 0.6, 1),
        (2.58, 6.4, 2.4, warm, 9.0, 2),
    ):
        panes = facade(s.rng, 0.6, tint, 4, 3) * strength + 1e-4
        s.bright_panel([x, y, z], [0, 0.8 if x < 0 else -0.8, 0], [0, 0, 0.65], panes, weight)
        s.box([x, y, z - 0.72], [0.1, 0.9, 0.05], s.matt(wood, 3))
    s.bright_panel([-0.6, 8.98, 2.6], [0.7, 0, 0], [0, 0, 0.9], facade(s.rng, 0.5, warm, 3, 4) * 3.0 + 1e-4, 1)
    # Lanterns on posts and brackets: small, and 10^5 times the darkest wall.
    for x, y, z, radiance, weight in (
        (-1.5, 2.2, 2.35, (520.0, 330.0, 140.0), 4),
        (1.6, 4.8, 2.5, (380.0, 400.0, 420.0), 3),
        (-1.4, 7.4, 2.4, (400.0, 240.0, 90.0), 2),
    ):
        iron = s.varnished((0.05, 0.06, 0.05), rough=0.3)
        s.lamp([x, y, z], 0.07, radiance, weight)
        s.rod([x, y, 0], [x, y, z - 0.09], 0.035, iron)
        s.drum([x, y, z + 0.1], 0.16, 0.05, iron)
    s.tube([2.35, 1.2, 1.95], [2.35, 2.2, 1.95], 0.02, (90.0, 6.0, 30.0), 1.5)
    s.tube([2.35, 1.2, 1.75], [2.35, 1.7, 1.75], 0.02, (4.0, 70.0, 30.0), 1)
    s.lamp([0.55, 0.9, 0.06], 0.02, (40.0, 1.0, 0.5), 0.2)
    # What stands about.
    s.crate((-1.9, 0.9, 0.0), 0.32)
    s.box([-1.7, 0.2, 0.2], [0.25, 0.25, 0.2], s.matt(wood, 5), 20)
    for x, y in ((1.7, 1.4), (2.0, 2.0), (1.5, 2.3)):
        s.drum([x, y, 0], 0.24, 0.7, s.varnished(wood, 10, rough=0.4))
    s.box([2.2, 0.6, 0.5], [0.3, 0.4, 0.5], s.matt(painting, 30), 10)
    s.box([0.5, 3.4, 0.28], [0.45, 0.8, 0.22], s.varnished(fabric, (0.25, 0.03, 0.03), (0.4, 0.1, 0.06)), 15)
    s.ball([0.6, 1.0, 0.3], 0.25, s.varnished(painting, 25, rough=0.25))
    s.plant([-2.1, 3.4, 0.1], 14, 0.8)


@recipe(Grid((0.0, -2.7, 1.5), (0.0, 1.5, 0.75), 1.0, 0.5, 52.0))
def overcast(s: Stage) -> None:
    """A garden corner under an even sky, nothing dark or bright: two decades at most, the sky out of view."""
    s.sky(
        np.full((16, 32, 3), (0.92, 0.97, 1.05), np.float32)
        * np.linspace(1.15, 0.75, 16, dtype=np.float32)[:, None, None]
    )

    def hills(x, y):
        return 0.10 * np.sin(1.3 * x + 0.4) * np.cos(1.1 * y) + 0.05 * np.sin(3.1 * x + 2.2 * y) - 0.05

    def lawn(u, v):
        x, y = (2 * u - 1) * 6, (2 * v - 1) * 6
        return np.stack([x, y, hills(x, y)], -1)

    grass = s.matt(ground, (0.14, 0.19, 0.07), (0.36, 0.42, 0.18), repeat=(3, 3))
    s.surface(lawn, 120, 120, [0, 1.5, 0], grass)
    wall = s.matt(brick, 20, 24, (0.34, 0.22, 0.17), (0.60, 0.44, 0.34), (0.5, 0.48, 0.45))
    s.panel([0, 4.2, 2.0], [6, 0, 0], [0, 0, 2.8], wall)
    for x in (-2.3, 0.1, 2.4):
        s.picture([x, 4.12, 1.6], 0.55, 0.45, 60, "Al")
    tones = {"gain": 0.8, "lift": 0.12}
    for k, (x, y, half) in enumerate(
        ((-1.9, 1.6, 0.4), (-1.2, 2.6, 0.55), (1.7, 2.4, 0.5), (0.5, 0.9, 0.28), (2.2, 1.1, 0.35))
    ):
        paint = (painting, 40) if k % 2 else (checker, 5, (0.2, 0.3, 0.25), (0.65, 0.6, 0.5))
        s.box([x, y, half - 0.05], [half, half, half], s.matt(*paint, **tones), 20.0 * k)
    s.ball([0.5, 0.9, 0.82], 0.3, s.varnished(globe, lift=0.08, rough=0.35), 60, 20)
    s.ball([-0.35, 0.5, 0.2], 0.25, s.matt(fabric, (0.5, 0.15, 0.12), (0.7, 0.62, 0.4), repeat=(2, 1)))
    s.vase([1.2, 0.4, -0.02], s.varnished(painting, 70, gain=0.8, lift=0.1, rough=0.35, repeat=(2, 1)), 0.75)
    for x, y, z, leaves, size in ((1.2, 0.4, 0.68, 12, 0.45), (-2.6, 2.9, 0.0, 22, 1.0), (-0.2, 3.0, 0.0, 20, 0.9)):
        s.plant([x, y, z], leaves, size)
    cloth = s.varnished(fabric, (0.2, 0.3, 0.5), (0.5, 0.55, 0.6), rough=0.35, repeat=(8, 1))
    s.knot([-0.9, 1.2, 0.28], cloth, 20)
    for _ in range(14):
        x, y, radius = s.rng.uniform(-2.8, 2.8), s.rng.uniform(-0.4, 2.8), s.rng.uniform(0.06, 0.16)
        s.ball([x, y, hills(x, y - 1.5) + 0.6 * radius], radius, s.matt(painting, 10, 64, gain=0.7, lift=0.15))
    fence = (wood, 3, (0.3, 0.26, 0.2), (0.55, 0.5, 0.42), 128)
    for k in range(9):
        s.rod([-3.2 + 0.8 * k, 3.6, 0], [-3.2 + 0.8 * k, 3.6, 0.95], 0.05, s.matt(*fence))
    s.rod([-3.4, 3.6, 0.75], [3.6, 3.6, 0.75], 0.04, s.matt(*fence))
