"""Four scenes indoors: a study, a room with a window, a room with its lamps in view, polished metal."""

# Long calls, a thing of a scene each: kept as short lists rather than a number a line.
# fmt: off

import numpy as np

from . import props, textures
from .cameras import Arc, Grid
from .shapes import lathe
from .stage import Stage

STUDY_VIEWS = Arc((0.0, 0.75, 1.0), 3.25, 34.0, (-3.0, 17.0))
WINDOW_VIEWS = Grid((0.0, -2.6, 1.35), (0.15, 2.0, 1.15), 1.05, 0.5, 52.0)
LAMPS_VIEWS = Arc((0.0, 0.8, 1.05), 3.2, 32.0, (-2.0, 18.0), field_of_view=54.0)
METAL_VIEWS = Grid((0.0, -1.15, 1.5), (0.0, 0.6, 0.87), 0.6, 0.3, 48.0)


def study(stage: Stage) -> None:
    """A furnished room under a ceiling panel and daylight from the side; at most a corner of the panel is in view."""
    rng = stage.rng
    props.room(stage, 2.7, -3.3, 2.2, 2.7, floor=stage.varnished(textures.wood(rng), 0.3, (1, 1.2)),
        ceiling=stage.matt(textures.brick(rng, 6, 4, (0.5, 0.5, 0.48), (0.68, 0.67, 0.64), (0.2, 0.2, 0.2))),
        left=stage.matt(textures.wallpaper(rng, stripe=(0.30, 0.17, 0.14), dot=(0.10, 0.16, 0.40)), (1.6, 1)),
        right=stage.matt(textures.wallpaper(rng), (1.6, 1)), front_wall=stage.matt(textures.plaster(rng)),
        back_wall=stage.matt(textures.brick(rng, 14, 9, (0.30, 0.24, 0.18), (0.62, 0.54, 0.42))))
    stage.bright_panel([0, 0.0, 2.68], [0.9, 0, 0], [0, -0.55, 0], (13.0, 12.0, 10.5), 3)
    stage.bright_panel([-2.68, -1.9, 1.5], [0, 0.7, 0], [0, 0, 0.6], (16.0, 19.0, 24.0), 2)
    stage.panel([0.1, -0.2, 0.006], [1.2, 0, 0], [0, 0.85, 0],
                stage.matt(textures.fabric(rng, (0.35, 0.05, 0.05), (0.60, 0.48, 0.30)), (2, 1.5)))
    top = props.table(stage, (0.1, 0.55), (0.8, 0.45))
    stage.ball([-0.35, 0.45, top + 0.17], 0.17, stage.varnished(textures.globe(rng), 0.15), 40, 20)
    for centre, half, colours, turn in (((0.45, 0.35, top + 0.09), (0.10, 0.09, 0.09),
        ((0.45, 0.06, 0.04), (0.75, 0.70, 0.25)), 25), ((0.45, 0.35, top + 0.23), (0.07, 0.06, 0.05),
        ((0.03, 0.12, 0.35), (0.60, 0.65, 0.70)), -15)):
        stage.box(centre, half, stage.varnished(textures.checker(rng, 4, *colours), 0.25), turn)
    props.vase(stage, [0.72, 0.72, top], stage.varnished(textures.painting(rng, 80), 0.15, (2, 1)))
    props.plant(stage, [0.72, 0.72, top + 0.38])
    props.knot(stage, [0.05, 0.30, top + 0.135], stage.varnished(textures.fabric(rng, (0.5, 0.2, 0.02),
        (0.7, 0.5, 0.1)), 0.2, (8, 1)))
    props.shelf(stage, (-1.45, 1.98), 0.6, 0.20, 4)
    props.armchair(stage, (1.65, 0.45), -28)
    props.crate(stage, (-1.4, 0.6, 0.0), 0.28)
    props.picture(stage, [0.15, 2.16, 1.75], [0.45, 0, 0], [0, 0, 0.32])
    props.picture(stage, [1.55, 2.16, 1.65], [0.32, 0, 0], [0, 0, 0.42], 90)
    props.picture(stage, [2.66, 0.9, 1.6], [0, -0.5, 0], [0, 0, 0.38], 60)
    stage.box([-1.9, -0.5, 0.22], [0.22, 0.22, 0.22],
              stage.varnished(textures.checker(rng, 5, (0.06, 0.22, 0.12), (0.6, 0.6, 0.5)), 0.25), 18)


def window(stage: Stage) -> None:
    """A dim room lit by a window that shows a bright street; one dark corner."""
    rng, (front, back, half, height), hole = stage.rng, (-3.3, 2.2, 2.4, 2.7), (0.25, 1.75, 0.95, 2.2)
    props.room(stage, half, front, back, height, floor=stage.varnished(textures.wood(rng, 8), 0.28, (1, 1.2)),
        ceiling=stage.matt(textures.wood(rng, 6, (0.4, 0.36, 0.3), (0.6, 0.56, 0.5)), (1, 2)),
        left=stage.matt(textures.painting(rng, 120, 512) * 0.5 + 0.2, (1.5, 1)),
        right=stage.matt(textures.wallpaper(rng), (1.6, 1)), front_wall=stage.matt(textures.plaster(rng)),
        back_wall=None)
    props.wall_with_hole(stage, back, (-half, half), height, hole, textures.brick(rng), (1.6, 1))
    props.window_frame(stage, back, hole, stage.varnished(textures.wood(rng, 3, (0.5, 0.47, 0.4), (0.75, 0.72, 0.66)),
        0.2))
    # Near behind the window, so that light drawn from it enters the room.
    stage.bright_panel([1.0, back + 0.4, 1.58], [1.0, 0, 0], [0, 0, 0.85], textures.outside(rng) * 60.0)
    top = props.table(stage, (0.35, 0.6), (0.75, 0.42))
    stage.ball([0.05, 0.5, top + 0.16], 0.16, stage.varnished(textures.globe(rng), 0.15), 120, 20)
    stage.box([0.62, 0.38, top + 0.09], [0.09, 0.09, 0.09],
        stage.varnished(textures.checker(rng, 4, (0.4, 0.05, 0.04), (0.75, 0.7, 0.3)), 0.25), 30)
    props.vase(stage, [0.85, 0.75, top], stage.varnished(textures.painting(rng, 60), 0.15, (2, 1)), 0.36)
    props.plant(stage, [0.85, 0.75, top + 0.33], 9, 0.25)
    props.shelf(stage, (-1.2, 1.98), 0.6, 0.20, 5)
    props.armchair(stage, (-0.65, 0.9), 30)
    props.crate(stage, (-1.55, 0.5, 0.0), 0.3)
    props.crate(stage, (1.5, 0.2, 0.0), 0.25)
    props.picture(stage, [-0.25, back - 0.04, 1.75], [0.28, 0, 0], [0, 0, 0.34], 50, "Cu")
    props.picture(stage, [half - 0.02, 0.9, 1.6], [0, -0.5, 0], [0, 0, 0.36], 60)
    stage.panel([0.0, -0.3, 0.006], [1.1, 0, 0], [0, 0.7, 0],
                stage.matt(textures.fabric(rng, (0.06, 0.10, 0.30), (0.60, 0.52, 0.38)), (2, 1.4)))


def lamps(stage: Stage) -> None:
    """An evening room whose lamps are in view: bulbs, a shaded lamp, a neon tube, a candle-like row, one red light."""
    rng = stage.rng
    props.room(stage, 2.6, -3.2, 2.3, 2.8, floor=stage.varnished(textures.checker(rng, 10, (0.10, 0.05, 0.03),
        (0.55, 0.48, 0.38)), 0.3), ceiling=stage.matt(textures.wood(rng, 7, (0.2, 0.13, 0.08), (0.4, 0.3, 0.2)),
        (1, 2)), left=stage.matt(textures.brick(rng, 16, 8, (0.2, 0.22, 0.25), (0.45, 0.46, 0.48))),
        right=stage.matt(textures.brick(rng)), front_wall=stage.matt(textures.plaster(rng)),
        back_wall=stage.matt(textures.wallpaper(rng, (0.36, 0.30, 0.34), (0.16, 0.20, 0.30), (0.6, 0.45, 0.12)),
        (1.8, 1)))
    steel, dark = stage.metal("Cr", 0.3), stage.matt((0.05, 0.05, 0.05))
    # Three hanging bulbs of different strength and colour, in front of the back wall.
    for x, y, z, radius, radiance, weight in ((-0.55, 0.9, 1.95, 0.05, (420.0, 290.0, 150.0), 5),
        (0.15, 0.6, 2.1, 0.05, (160.0, 185.0, 220.0), 4), (0.95, 1.1, 1.9, 0.06, (90.0, 52.0, 22.0), 3)):
        stage.lamp([x, y, z], radius, radiance, weight)
        stage.rod([x, y, z + radius], [x, y, 2.8], 0.008, dark)
    # A floor lamp: the bulb shows below its shade from low viewpoints.
    stage.lamp([1.75, 1.5, 1.5], 0.06, (300.0, 215.0, 120.0), 4)
    stage.rod([1.75, 1.5, 0], [1.75, 1.5, 1.44], 0.018, steel)
    stage.drum([1.75, 1.5, 0], 0.16, 0.03, steel)
    stage.surface(lathe([[0.16, 0.20], [0.24, 0.08], [0.32, -0.04]]), 64, 30, [1.75, 1.5, 1.5],
                  stage.matt(textures.fabric(rng, (0.3, 0.2, 0.1), (0.6, 0.5, 0.3))))
    # A neon tube on the back wall and a red light on the shelf: saturated colours.
    stage.tube([-0.1, 2.24, 2.35], [1.1, 2.24, 2.35], 0.018, (6.0, 26.0, 60.0), 2)
    stage.lamp([-1.15, 1.85, 1.85], 0.025, (70.0, 2.0, 1.0), 0.5)
    top = props.table(stage, (0.1, 0.6), (0.8, 0.42))
    for k in range(4):
        x = -0.5 + 0.4 * k
        stage.drum([x, 0.9, top], 0.03, 0.12, stage.matt(textures.fabric(rng, (0.5, 0.4, 0.3), (0.8, 0.75, 0.6), 64)))
        stage.lamp([x, 0.9, top + 0.15], 0.018, (260.0, 130.0, 40.0), 1)
    stage.ball([-0.3, 0.4, top + 0.15], 0.15, stage.varnished(textures.globe(rng), 0.2), 200, 20)
    props.knot(stage, [0.15, 0.35, top + 0.135], stage.metal("Au", 0.25))
    props.vase(stage, [0.6, 0.45, top], stage.varnished(textures.painting(rng, 70), 0.2, (2, 1)), 0.34)
    props.shelf(stage, (-1.35, 2.05), 0.6, 0.20, 4)
    props.armchair(stage, (-1.5, 0.6), 35)
    props.crate(stage, (1.35, 0.45, 0.0), 0.3)
    props.picture(stage, [-0.1, 2.26, 1.6], [0.4, 0, 0], [0, 0, 0.3], 60)
    props.picture(stage, [-2.57, 0.9, 1.6], [0, 0.5, 0], [0, 0, 0.36], 60)
    stage.panel([0.1, -0.4, 0.006], [1.2, 0, 0], [0, 0.75, 0],
                stage.matt(textures.fabric(rng, (0.04, 0.2, 0.16), (0.55, 0.5, 0.3)), (2, 1.4)))


def metal(stage: Stage) -> None:
    """A still life of polished metals and lacquer under two soft boxes and three small spots: sharp highlights."""
    rng = stage.rng
    props.room(stage, 2.4, -2.8, 2.0, 2.8, floor=stage.matt(textures.brick(rng, 8, 8, (0.25, 0.2, 0.18),
        (0.5, 0.42, 0.36))), ceiling=stage.matt(textures.checker(rng, 6, (0.1, 0.1, 0.11), (0.3, 0.3, 0.32))),
        left=stage.matt(textures.painting(rng, 90, 512)), right=stage.matt(textures.wallpaper(rng, (0.5, 0.3, 0.2),
        (0.2, 0.1, 0.1), (0.6, 0.55, 0.2)), (1.5, 1)), front_wall=stage.matt(textures.brick(rng)),
        back_wall=stage.matt(textures.brick(rng, 22, 9, (0.08, 0.12, 0.16), (0.24, 0.32, 0.38), (0.4, 0.4, 0.38))))
    stage.bright_panel([-1.5, -0.6, 2.5], [0.45, 0.2, 0], [0.15, -0.35, 0.3], (30.0, 28.0, 25.0), 4)
    stage.bright_panel([1.7, 0.2, 2.2], [0.0, 0.35, 0.0], [-0.2, 0.0, -0.35], (14.0, 18.0, 26.0), 2)
    for x, y in ((-0.5, -0.3), (0.35, 0.0), (0.1, 1.2)):
        stage.lamp([x, y, 2.6], 0.06, (420.0, 370.0, 300.0), 1.5)
    top = props.table(stage, (0.0, 0.75), (1.15, 0.75), 0.74)
    stage.box([0, 0.75, top + 0.005], [0.95, 0.6, 0.005],
              stage.matt(textures.fabric(rng, (0.30, 0.04, 0.06), (0.62, 0.55, 0.42))))
    floor = top + 0.01
    pot = lathe([[0.001, 0], [0.10, 0.0], [0.16, 0.08], [0.15, 0.2], [0.09, 0.27], [0.06, 0.33], [0.08, 0.36]])
    bowl = lathe([[0.001, 0.02], [0.07, 0.0], [0.07, 0.03], [0.16, 0.1], [0.22, 0.19], [0.21, 0.19], [0.15, 0.1],
        [0.001, 0.05]])
    stage.surface(pot, 64, 96, [-0.5, 0.95, floor], stage.metal("Cu", 0.12))
    stage.surface(pot, 64, 96, [0.62, 1.1, floor], stage.metal("Ag", 0.1))
    stage.surface(bowl, 64, 96, [0.1, 0.55, floor], stage.metal("Au", 0.14))
    props.knot(stage, [-0.32, 0.42, floor + 0.14], stage.metal("Cr", 0.12), 65, 20)
    stage.ball([0.5, 0.55, floor + 0.12], 0.12, stage.metal("Al", 0.1))
    for x, y, radius, colours in ((-0.72, 0.5, 0.07, ((0.5, 0.03, 0.02), (0.7, 0.5, 0.1))),
        (0.78, 0.7, 0.08, ((0.02, 0.2, 0.4), (0.5, 0.6, 0.6)))):
        stage.ball([x, y, floor + radius], radius, stage.varnished(textures.fabric(rng, *colours), 0.1, (2, 1)))
    for k in range(6):
        angle = 0.9 * k
        stage.ball([0.1 + 0.07 * np.cos(angle), 0.55 + 0.07 * np.sin(angle), floor + 0.12 + 0.015 * k], 0.045,
                   stage.varnished(textures.painting(rng, 20, 128), 0.12))
    for k in range(5):
        stage.drum([-0.1 + 0.09 * k, 0.22 + 0.02 * (k % 2), floor], 0.035, 0.012 + 0.02 * rng.random(),
            stage.metal(("Au", "Cu", "Ag")[k % 3], 0.18))
    stage.drum([0.02, 1.15, floor], 0.1, 0.34, stage.metal("W", 0.2))
    stage.box([-0.12, 1.2, floor + 0.1], [0.05, 0.05, 0.1], stage.varnished(textures.checker(rng, 4), 0.12), 30)
    for x in (-1.3, 0.1, 1.4):
        props.picture(stage, [x, 1.97, 1.75], [0.42, 0, 0], [0, 0, 0.32], 50, "Cu")
