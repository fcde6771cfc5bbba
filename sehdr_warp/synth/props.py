"""Things that several scenes share: rooms with walls, furniture, vessels, plants."""

import numpy as np

from . import textures
from .shapes import lathe, leaf, torus_knot
from .stage import Material, Stage


def room(stage: Stage, half_width: float, front: float, back: float, height: float, *, floor: Material,
         ceiling: Material, left: Material, right: Material, front_wall: Material,
         back_wall: Material | None):  # fmt: skip
    """Six panels facing inwards; back_wall None leaves the +y side open, for a wall with a hole."""
    middle, half = (front + back) / 2, (back - front) / 2
    stage.panel([0, middle, 0], [half_width, 0, 0], [0, half, 0], floor)
    stage.panel([0, middle, height], [half_width, 0, 0], [0, -half, 0], ceiling)
    stage.panel([-half_width, middle, height / 2], [0, half, 0], [0, 0, height / 2], left)
    stage.panel([half_width, middle, height / 2], [0, -half, 0], [0, 0, height / 2], right)
    stage.panel([0, front, height / 2], [-half_width, 0, 0], [0, 0, height / 2], front_wall)
    if back_wall is not None:
        stage.panel([0, back, height / 2], [half_width, 0, 0], [0, 0, height / 2], back_wall)


def wall_with_hole(stage: Stage, y: float, across: tuple[float, float], height: float, hole, texture, repeat) -> None:
    """A wall in the plane y from x = across[0] to across[1], with a hole (x0, x1, z0, z1); one texture over all."""
    x0, x1, z0, z1 = hole
    left, right = across
    for a, b, c, d in ((left, x0, 0, height), (x1, right, 0, height), (x0, x1, 0, z0), (x0, x1, z1, height)):
        paint = stage.paint(texture)
        scale = [repeat[0] / (right - left), repeat[1] / height]
        paint["to_uv"] = (
            stage.mi.ScalarTransform3f()
            .translate([(a - left) * scale[0], c * scale[1]])
            .scale([(b - a) * scale[0], (d - c) * scale[1]])
        )
        material = {"type": "twosided", "layer": {"type": "diffuse", "reflectance": paint}}
        stage.panel([(a + b) / 2, y, (c + d) / 2], [(b - a) / 2, 0, 0], [0, 0, (d - c) / 2], material)


def window_frame(stage: Stage, y: float, hole, material: Material) -> None:
    """Bars and a sill for wall_with_hole's hole."""
    x0, x1, z0, z1 = hole
    x, z, half_x, half_z = (x0 + x1) / 2, (z0 + z1) / 2, (x1 - x0) / 2, (z1 - z0) / 2
    for level in (z0, z1, z + half_z / 3):
        stage.box([x, y, level], [half_x + 0.04, 0.06, 0.025], material)
    for place in (x0, x1, x):
        stage.box([place, y, z], [0.025, 0.06, half_z], material)
    stage.box([x, y - 0.10, z0 - 0.03], [half_x + 0.10, 0.12, 0.02], material)


def table(stage: Stage, centre, half, height: float = 0.72) -> float:
    """A wooden table around (x, y); returns the height of its top."""
    x, y = centre
    board = textures.wood(stage.rng, 4, (0.08, 0.04, 0.02), (0.34, 0.20, 0.11))
    stage.box([x, y, height - 0.025], [half[0], half[1], 0.025], stage.varnished(board, 0.2))
    for side in (-0.9, 0.9):
        for end in (-0.85, 0.85):
            foot = [x + side * half[0], y + end * half[1], 0]
            stage.rod(foot, [foot[0], foot[1], height - 0.04], 0.03, stage.varnished(board, 0.25))
    return height


def shelf(stage: Stage, centre, half_width: float, depth: float, levels: int) -> None:
    """A bookcase standing at (x, y), open towards -y, full of books; its depths are dark."""
    rng, (x, y), gap = stage.rng, centre, 0.42
    boards = stage.varnished(textures.wood(rng, 2, (0.05, 0.03, 0.02), (0.20, 0.12, 0.07)), 0.3)
    half = levels * gap / 2
    for level in range(levels + 1):
        stage.box([x, y, 0.02 + level * gap], [half_width, depth, 0.018], boards)
    for side in (-1, 1):
        stage.box([x + side * half_width, y, half], [0.018, depth, half + 0.02], boards)
    stage.box([x, y + depth, half], [half_width, 0.01, half], boards)
    for level in range(levels):
        place = x - half_width + 0.03
        while place < x + half_width - 0.10:
            thick, high = 0.015 + 0.022 * rng.random(), 0.11 + 0.06 * rng.random()
            if rng.random() < 0.12:
                place += 0.06
                continue
            back = stage.varnished(textures.books(rng), 0.3)
            stage.box([place + thick, y - 0.03 + 0.03 * rng.random(), 0.04 + level * gap + high],
                      [thick, depth * 0.65, high], back)  # fmt: skip
            place += 2 * thick + 0.003


def picture(stage: Stage, centre, half_u, half_v, cells: int = 40, frame: str = "Au") -> None:
    """A framed painting that faces half_u x half_v."""
    half_u, half_v, centre = (np.asarray(v, float) for v in (half_u, half_v, centre))
    facing = np.cross(half_u, half_v)
    facing /= np.linalg.norm(facing)
    stage.panel(centre + 0.02 * facing, half_u, half_v, stage.varnished(textures.painting(stage.rng, cells), 0.15))
    for sign in (-1, 1):
        for along, across in ((half_u, half_v), (half_v, half_u)):
            ends = [centre + sign * across * 1.04 + s * along * 1.04 for s in (-1, 1)]
            stage.rod(*ends, 0.025, stage.metal(frame, 0.3))


def vase(stage: Stage, centre, material: Material, height: float = 0.42) -> None:
    line = np.array([[0.01, 0], [0.08, 0.0], [0.13, 0.12], [0.10, 0.26], [0.05, 0.36], [0.075, 0.42]]) * (height / 0.42)
    stage.surface(lathe(line), 64, 96, centre, material)


def plant(stage: Stage, centre, leaves: int = 11, size: float = 0.3) -> None:
    """Broad leaves from one place."""
    rng = stage.rng
    for k in range(leaves):
        colour = stage.varnished(textures.fabric(rng, (0.03, 0.16, 0.03), (0.16, 0.40, 0.08), 64), 0.3)
        length, lean = size * rng.uniform(0.8, 1.3), rng.uniform(0.3, 0.85)
        stage.surface(leaf(length, 0.16 * length, lean, k * 2.399), 20, 7, centre, colour)


def knot(stage: Stage, centre, material: Material, tilt: float = 65.0, turn: float = 0.0) -> None:
    stage.surface(torus_knot(), 300, 24, centre, material, turn=turn, tilt=tilt)


def crate(stage: Stage, centre, half: float) -> None:
    """A box open towards -y, dark inside, with a ball in it."""
    x, y, z = centre
    boards = stage.matt(textures.wood(stage.rng, 5, (0.20, 0.12, 0.06), (0.50, 0.34, 0.18)))
    for side in (-1, 1):
        stage.box([x + side * half, y, z + half], [0.015, half, half], boards)
        stage.box([x, y, z + half + side * (half - 0.015)], [half, half, 0.015], boards)
    stage.box([x, y + half, z + half], [half, 0.015, half], boards)
    stage.ball([x + 0.05, y + 0.1, z + 0.03 + 0.4 * half], 0.4 * half,
               stage.varnished(textures.checker(stage.rng, 10), 0.2))  # fmt: skip


def armchair(stage: Stage, centre, turn: float) -> None:
    """Upholstered boxes; `turn` 0 faces -y."""
    cloth = stage.matt(textures.fabric(stage.rng, (0.05, 0.10, 0.22), (0.26, 0.36, 0.46)), (2, 2))
    angle = np.radians(turn)
    for (dx, dy, z), half in (
        ((0, 0, 0.24), (0.36, 0.36, 0.20)),
        ((0, 0.32, 0.58), (0.40, 0.10, 0.42)),
        ((0.36, 0, 0.40), (0.09, 0.36, 0.24)),
        ((-0.36, 0, 0.40), (0.09, 0.36, 0.24)),
    ):
        place = [
            centre[0] + dx * np.cos(angle) - dy * np.sin(angle),
            centre[1] + dx * np.sin(angle) + dy * np.cos(angle),
        ]
        stage.box([*place, z], half, cloth, turn)
