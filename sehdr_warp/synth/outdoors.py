"""Four scenes in the open or through glass: glass and water, a sunlit court, a street at night, an overcast garden."""

# Long calls, a thing of a scene each: kept as short lists rather than a number a line.
# fmt: off

import numpy as np

from . import props, textures
from .cameras import Arc, Grid
from .shapes import lathe, sheet
from .stage import Stage

GLASS_VIEWS = Arc((0.0, 0.45, 0.95), 1.9, 30.0, (3.0, 24.0), field_of_view=46.0)
SUNLIT_VIEWS = Arc((0.0, 1.5, 1.1), 5.2, 32.0, (3.0, 20.0), field_of_view=52.0)
NIGHT_VIEWS = Grid((0.0, -4.2, 1.7), (0.0, 3.0, 1.6), 1.3, 0.6, 54.0)
OVERCAST_VIEWS = Grid((0.0, -2.7, 1.5), (0.0, 1.5, 0.75), 1.0, 0.5, 52.0)


def glass(stage: Stage) -> None:
    """Clear and tinted glass and a basin of water on a table before a bright, patterned screen."""
    rng = stage.rng
    props.room(stage, 2.4, -2.4, 1.9, 2.8, floor=stage.matt(textures.wood(rng, 8)),
        ceiling=stage.matt(textures.brick(rng, 8, 6, (0.4, 0.4, 0.4), (0.6, 0.6, 0.6))),
        left=stage.matt(textures.brick(rng, 14, 7), (1.4, 1)),
        right=stage.matt(textures.wallpaper(rng, (0.3, 0.42, 0.4), (0.12, 0.22, 0.3), (0.55, 0.3, 0.1)), (1.5, 1)),
        front_wall=stage.matt(textures.plaster(rng)), back_wall=stage.matt(textures.brick(rng, 20, 9,
        (0.16, 0.10, 0.08), (0.42, 0.30, 0.24))))
    # All lights are large: what glass bends is found by chance, and a large light is found often.
    stage.bright_panel([-0.35, 1.86, 1.35], [0.6, 0, 0], [0, 0, 0.45], textures.painting(rng, 30) ** 1.3 * 45.0 + 1.0,
        3)
    stage.bright_panel([0, 0.2, 2.78], [0.9, 0, 0], [0, -0.8, 0], (9.0, 9.5, 10.0), 3)
    stage.bright_panel([2.38, 0.2, 1.7], [0, -0.6, 0], [0, 0, 0.5], (16.0, 12.0, 8.0), 2)
    top = props.table(stage, (0.0, 0.55), (1.0, 0.6), 0.72)
    stage.box([0, 0.55, top + 0.003], [0.98, 0.58, 0.003],
        stage.matt(textures.checker(rng, 12, (0.08, 0.1, 0.16), (0.7, 0.68, 0.6))))
    floor = top + 0.008
    clear, green, amber, water = (stage.glass(), stage.glass(tint=(0.72, 0.93, 0.80)),
        stage.glass(tint=(0.95, 0.75, 0.42)), stage.glass(1.33, (0.93, 0.97, 0.99)))
    stage.ball([-0.38, 0.3, floor + 0.15], 0.15, clear)
    stage.ball([0.32, 0.18, floor + 0.09], 0.09, amber)
    stage.ball([0.02, 0.12, floor + 0.06], 0.06, green)
    goblet = lathe([[0.001, 0], [0.09, 0.002], [0.09, 0.012], [0.015, 0.03], [0.013, 0.14], [0.06, 0.2], [0.09, 0.3],
                    [0.075, 0.4], [0.068, 0.398], [0.08, 0.3], [0.05, 0.215], [0.001, 0.19]])
    bottle = lathe([[0.001, 0], [0.085, 0.003], [0.09, 0.04], [0.09, 0.22], [0.04, 0.32], [0.03, 0.42], [0.034, 0.43],
        [0.001, 0.432]])
    stage.surface(goblet, 72, 140, [0.05, 0.42, floor], clear)
    stage.surface(bottle, 72, 120, [-0.1, 0.82, floor], green)
    stage.surface(bottle, 72, 120, [-0.62, 0.75, floor], amber)
    # Water stands free, as a block with pebbles and a striped reed in it; glass around it would show little more.
    stage.box([0.55, 0.62, floor + 0.13], [0.24, 0.18, 0.125], water)
    for _ in range(14):
        radius = rng.uniform(0.02, 0.045)
        place = [0.55 + rng.uniform(-0.18, 0.18), 0.62 + rng.uniform(-0.12, 0.12), floor + 0.01 + radius]
        stage.ball(place, radius, stage.matt(textures.painting(rng, 8, 64)))
    stage.rod([0.45, 0.6, floor + 0.02], [0.68, 0.66, floor + 0.5], 0.012,
              stage.matt(textures.checker(rng, 16, (0.5, 0.05, 0.04), (0.8, 0.78, 0.7)), (0.1, 2)))
    stage.ball([-0.3, 0.55, floor + 0.07], 0.07, stage.varnished(textures.globe(rng), 0.2))
    stage.box([-0.85, 0.4, floor + 0.06], [0.06, 0.06, 0.06],
        stage.varnished(textures.checker(rng, 4, (0.4, 0.05, 0.05), (0.7, 0.65, 0.3)), 0.25), 20)
    props.vase(stage, [0.86, 0.3, floor], stage.varnished(textures.painting(rng, 60), 0.2, (2, 1)), 0.3)
    props.picture(stage, [0.95, 1.87, 1.45], [0.38, 0, 0], [0, 0, 0.42], 50)
    props.shelf(stage, (-1.7, 1.68), 0.5, 0.18, 4)


def sunlit(stage: Stage) -> None:
    """A court in hard afternoon sun: hot stone and metal, deep shadow under an arcade, an open dark door."""
    rng = stage.rng
    stone = textures.brick(rng, 14, 8, (0.42, 0.36, 0.28), (0.68, 0.60, 0.48), (0.3, 0.27, 0.22))
    stage.sky(textures.sky(rng, (0.35, 0.62, 1.35), (1.3, 1.5, 1.7), 2.0, (0.5, 0.45, 0.38)), 1)
    # From behind and to the left of the cameras, 42 degrees high.
    sun = np.array([0.62, 0.52, -0.73])
    stage.sun(sun / np.linalg.norm(sun), (30.0, 27.0, 22.0), 2)
    stage.panel([0, 2, 0], [9, 0, 0], [0, 9, 0], stage.matt(textures.brick(rng, 24, 24, (0.3, 0.27, 0.24),
        (0.52, 0.48, 0.42))))
    # The house: a front with a dark door, and a roof over an arcade to the right.
    hole = (-1.55, -0.35, 0.0, 2.1)
    props.wall_with_hole(stage, 3.4, (-4.5, 4.5), 3.4, hole, stone, (2.0, 1.0))
    stage.panel([-0.85, 5.4, 1.0], [0.9, 0, 0], [0, 0, 1.1], stage.matt(textures.painting(rng, 30) * 0.12))
    for side in (-1, 1):
        sooty = stage.matt(textures.wallpaper(rng) * 0.12)
        stage.panel([-0.85 + 0.9 * side, 4.4, 1.0], [0, -side, 0], [0, 0, 1.1], sooty)
    stage.panel([-0.85, 4.4, 2.1], [0.9, 0, 0], [0, -1.0, 0], stage.matt((0.05, 0.04, 0.03)))
    stage.panel([-0.85, 4.4, 0.01], [0.9, 0, 0], [0, 1.0, 0], stage.matt(textures.checker(rng, 6) * 0.2))
    tiles = textures.brick(rng, 10, 10, (0.35, 0.12, 0.07), (0.6, 0.26, 0.16), (0.15, 0.06, 0.04))
    stage.panel([2.1, 2.5, 2.35], [2.0, 0, 0], [0, 0.95, 0.12], stage.matt(tiles, (2, 1)))
    stage.panel([2.1, 2.5, 2.33], [2.0, 0, 0], [0, -0.95, -0.12], stage.matt(textures.wood(rng, 12), (1, 1)))
    for k in range(4):
        stage.drum([0.35 + 1.15 * k, 1.75, 0], 0.11, 2.25, stage.matt(textures.brick(rng, 12, 4, (0.45, 0.4, 0.33),
            (0.66, 0.6, 0.5))))
    for x, turn in ((1.0, 10), (2.4, -15)):
        stage.drum([x, 2.7, 0], 0.3, 0.8, stage.matt(textures.wood(rng, 9)))
        stage.box([x + 0.55, 2.9, 0.2], [0.2, 0.2, 0.2], stage.matt(textures.checker(rng, 4, (0.2, 0.1, 0.05),
            (0.5, 0.4, 0.25))), turn)
    stage.box([-2.6, 3.3, 2.0], [0.45, 0.12, 0.6], stage.varnished(textures.wood(rng, 5, (0.03, 0.12, 0.10),
        (0.10, 0.32, 0.26)), 0.3))
    for x, z in ((0.6, 2.75), (2.0, 2.75), (3.2, 2.75)):
        props.picture(stage, [x, 3.37, z], [0.35, 0, 0], [0, 0, 0.3], 20, "Cu")
    # Things in the sun.
    stage.drum([-2.2, 1.2, 0], 0.55, 0.35, stage.matt(stone, (2, 0.4)))
    props.plant(stage, [-2.2, 1.2, 0.35], 18, 0.75)
    stage.drum([-0.3, 0.7, 0], 0.3, 0.75, stage.matt(textures.wood(rng, 10, (0.3, 0.2, 0.1), (0.6, 0.45, 0.28))))
    stage.ball([-0.3, 0.7, 1.02], 0.27, stage.metal("Au", 0.08))
    stage.box([0.75, 0.5, 0.3], [0.3, 0.3, 0.3], stage.matt(textures.painting(rng, 30)), 25)
    stage.ball([0.75, 0.5, 0.82], 0.22, stage.varnished(textures.globe(rng), 0.15), 100, 20)
    props.crate(stage, (-1.2, 1.6, 0.0), 0.35)
    props.knot(stage, [1.55, 0.9, 0.16], stage.metal("Cu", 0.1), 0)
    stage.box([2.1, 0.6, 0.22], [0.6, 0.2, 0.22], stage.matt(textures.brick(rng, 5, 6)), -20)
    stage.box([-3.6, 2.2, 0.9], [0.5, 0.9, 0.9], stage.matt(textures.brick(rng, 12, 8)), 8)


def night(stage: Stage) -> None:
    """A narrow street under a moonless sky: lanterns, lit windows, a sign, a shop; near black between them."""
    rng = stage.rng
    stage.sky(textures.sky(rng, (0.0006, 0.0008, 0.0016), (0.0025, 0.0022, 0.002), 0.6, (0.0, 0.0, 0.0)), 0.3)
    cobbles = textures.brick(rng, 26, 22, (0.10, 0.10, 0.11), (0.34, 0.33, 0.32), (0.04, 0.04, 0.04))
    stage.panel([0, 4, 0], [3.2, 0, 0], [0, 10, 0], stage.varnished(cobbles, 0.35, (2, 6)))
    left = textures.brick(rng, 22, 22, (0.22, 0.10, 0.07), (0.48, 0.26, 0.18))
    right = textures.brick(rng, 18, 20, (0.26, 0.25, 0.22), (0.5, 0.48, 0.42))
    stage.panel([-2.6, 4, 5.0], [0, 9, 0], [0, 0, 5.0], stage.matt(left, (2, 1.6)))
    stage.panel([2.6, 4, 5.0], [0, -9, 0], [0, 0, 5.0], stage.matt(right, (2, 1.6)))
    stage.panel([0, 9.0, 4.2], [2.6, 0, 0], [0, 0, 4.2], stage.matt(textures.brick(rng, 16, 12, (0.2, 0.2, 0.24),
        (0.4, 0.4, 0.44))))
    # Windows: a few rows glow, each pane with its own strength.
    warm, cold = (1.0, 0.60, 0.26), (0.5, 0.75, 1.0)
    for x, y, z, tint, strength, weight in ((-2.58, 1.4, 2.7, warm, 5.0, 2), (-2.58, 4.6, 2.5, cold, 1.2, 1),
        (2.58, 3.2, 2.9, warm, 0.6, 1), (2.58, 6.4, 2.4, warm, 9.0, 2)):
        side = 1 if x < 0 else -1
        panes = textures.facade(rng, 0.6, tint, 4, 3) * strength + 1e-4
        stage.bright_panel([x, y, z], [0, side * 0.8, 0], [0, 0, 0.65], panes, weight)
        stage.box([x, y, z - 0.72], [0.1, 0.9, 0.05], stage.matt(textures.wood(rng, 3)))
    stage.bright_panel([-0.6, 8.98, 2.6], [0.7, 0, 0], [0, 0, 0.9], textures.facade(rng, 0.5, warm, 3, 4) * 3.0 + 1e-4,
        1)
    # Lanterns on posts and brackets: small, and 10^5 times the darkest wall.
    for x, y, z, radiance, weight in ((-1.5, 2.2, 2.35, (520.0, 330.0, 140.0), 4),
        (1.6, 4.8, 2.5, (380.0, 400.0, 420.0), 3), (-1.4, 7.4, 2.4, (400.0, 240.0, 90.0), 2)):
        stage.lamp([x, y, z], 0.07, radiance, weight)
        stage.rod([x, y, 0], [x, y, z - 0.09], 0.035, stage.varnished((0.05, 0.06, 0.05), 0.3))
        stage.drum([x, y, z + 0.1], 0.16, 0.05, stage.varnished((0.05, 0.06, 0.05), 0.3))
    stage.tube([2.35, 1.2, 1.95], [2.35, 2.2, 1.95], 0.02, (90.0, 6.0, 30.0), 1.5)
    stage.tube([2.35, 1.2, 1.75], [2.35, 1.7, 1.75], 0.02, (4.0, 70.0, 30.0), 1)
    stage.lamp([0.55, 0.9, 0.06], 0.02, (40.0, 1.0, 0.5), 0.2)
    # What stands about.
    props.crate(stage, (-1.9, 0.9, 0.0), 0.32)
    stage.box([-1.7, 0.2, 0.2], [0.25, 0.25, 0.2], stage.matt(textures.wood(rng, 5)), 20)
    for x, y in ((1.7, 1.4), (2.0, 2.0), (1.5, 2.3)):
        stage.drum([x, y, 0], 0.24, 0.7, stage.varnished(textures.wood(rng, 10), 0.4))
    stage.box([2.2, 0.6, 0.5], [0.3, 0.4, 0.5], stage.matt(textures.painting(rng, 30)), 10)
    stage.box([0.5, 3.4, 0.28], [0.45, 0.8, 0.22], stage.varnished(textures.fabric(rng, (0.25, 0.03, 0.03),
        (0.4, 0.1, 0.06)), 0.2), 15)
    stage.ball([0.6, 1.0, 0.3], 0.25, stage.varnished(textures.painting(rng, 25), 0.25))
    props.plant(stage, [-2.1, 3.4, 0.1], 14, 0.8)


def overcast(stage: Stage) -> None:
    """A garden corner under an even sky, nothing dark or bright: two decades at most, the sky out of view."""
    rng = stage.rng
    grey = (np.full((16, 32, 3), (0.92, 0.97, 1.05), np.float32) * np.linspace(1.15, 0.75, 16, dtype=np.float32)[:,
        None, None])
    stage.sky(grey)

    def hills(x, y):
        return 0.10 * np.sin(1.3 * x + 0.4) * np.cos(1.1 * y) + 0.05 * np.sin(3.1 * x + 2.2 * y) - 0.05

    stage.surface(sheet(6, 6, hills), 120, 120, [0, 1.5, 0],
        stage.matt(textures.ground(rng, (0.14, 0.19, 0.07), (0.36, 0.42, 0.18)), (3, 3)))
    stage.panel([0, 4.2, 2.0], [6, 0, 0], [0, 0, 2.8], stage.matt(textures.brick(rng, 20, 24, (0.34, 0.22, 0.17),
        (0.60, 0.44, 0.34), (0.5, 0.48, 0.45))))
    for x in (-2.3, 0.1, 2.4):
        props.picture(stage, [x, 4.12, 1.6], [0.55, 0, 0], [0, 0, 0.45], 60, "Al")
    for k, (x, y, half) in enumerate(((-1.9, 1.6, 0.4), (-1.2, 2.6, 0.55), (1.7, 2.4, 0.5), (0.5, 0.9, 0.28),
        (2.2, 1.1, 0.35))):
        paint = textures.painting(rng, 40) if k % 2 else textures.checker(rng, 5, (0.2, 0.3, 0.25), (0.65, 0.6, 0.5))
        stage.box([x, y, half - 0.05], [half, half, half], stage.matt(paint * 0.8 + 0.12), 20.0 * k)
    stage.ball([0.5, 0.9, 0.82], 0.3, stage.varnished(textures.globe(rng) + 0.08, 0.35), 60, 20)
    stage.ball([-0.35, 0.5, 0.2], 0.25, stage.matt(textures.fabric(rng, (0.5, 0.15, 0.12), (0.7, 0.62, 0.4)), (2, 1)))
    props.vase(stage, [1.2, 0.4, -0.02], stage.varnished(textures.painting(rng, 70) * 0.8 + 0.1, 0.35, (2, 1)), 0.75)
    props.plant(stage, [1.2, 0.4, 0.68], 12, 0.45)
    props.plant(stage, [-2.6, 2.9, 0.0], 22, 1.0)
    props.plant(stage, [-0.2, 3.0, 0.0], 20, 0.9)
    props.knot(stage, [-0.9, 1.2, 0.28], stage.varnished(textures.fabric(rng, (0.2, 0.3, 0.5), (0.5, 0.55, 0.6)), 0.35,
        (8, 1)), 20)
    for _ in range(14):
        place = [rng.uniform(-2.8, 2.8), rng.uniform(-0.4, 2.8)]
        radius = rng.uniform(0.06, 0.16)
        stage.ball([*place, float(hills(place[0], place[1] - 1.5)) + 0.6 * radius], radius,
            stage.matt(textures.painting(rng, 10, 64) * 0.7 + 0.15))
    for k in range(9):
        stage.rod([-3.2 + 0.8 * k, 3.6, 0], [-3.2 + 0.8 * k, 3.6, 0.95], 0.05,
            stage.matt(textures.wood(rng, 3, (0.3, 0.26, 0.2), (0.55, 0.5, 0.42), 128)))
    stage.rod([-3.4, 3.6, 0.75], [3.6, 3.6, 0.75], 0.04, stage.matt(textures.wood(rng, 3, (0.3, 0.26, 0.2),
        (0.55, 0.5, 0.42), 128)))
