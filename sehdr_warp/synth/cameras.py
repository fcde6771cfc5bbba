"""Where the 35 views stand: HDR-NeRF's forward-facing grid, or a wide arc. Metres, z up."""

import math
from dataclasses import dataclass

import numpy as np

from ..scene import Camera, look_at

COLUMNS, ROWS = 7, 5
VIEWS = COLUMNS * ROWS
"""HDR-NeRF's number of views; the even ones train (18), the odd ones test (17)."""


@dataclass(frozen=True)
class Grid:
    """Parallel cameras on a plane, as HDR-NeRF's synthetic sets have them: small baseline, all looking one way.

    centre: the middle camera's place; target: where it looks. width, height: of the grid, metres.
    """

    centre: tuple[float, float, float]
    target: tuple[float, float, float]
    width: float
    height: float
    field_of_view: float = 50.0

    def poses(self) -> list[np.ndarray]:
        middle = look_at(self.centre, self.target)
        right, down = middle[:2, :3]
        poses = []
        for s, t in _places():
            pose = middle.copy()
            pose[:3, 3] = -pose[:3, :3] @ (self.centre + right * self.width * s + down * self.height * t)
            poses.append(pose)
        return poses


@dataclass(frozen=True)
class Arc:
    """Cameras on a part of a sphere, all looking at its centre.

    target: the sphere's centre; radius: metres; azimuth: degrees to either side of the -y direction (turned by
    `heading` degrees); elevation: lowest and highest, degrees.
    """

    target: tuple[float, float, float]
    radius: float
    azimuth: float
    elevation: tuple[float, float]
    heading: float = 0.0
    field_of_view: float = 50.0

    def poses(self) -> list[np.ndarray]:
        poses = []
        for s, t in _places():
            turn = math.radians(self.heading + 2 * self.azimuth * s)
            low, high = self.elevation
            rise = math.radians(0.5 * (low + high) - (high - low) * t)
            away = np.array([math.sin(turn) * math.cos(rise), -math.cos(turn) * math.cos(rise), math.sin(rise)])
            poses.append(look_at(self.target + self.radius * away, self.target))
        return poses


def make_cameras(layout: Grid | Arc, width: int, height: int) -> list[Camera]:
    """The 35 cameras of a layout, rows from top to bottom; field_of_view is across the width, degrees."""
    focal = 0.5 * width / math.tan(math.radians(layout.field_of_view) / 2)
    return [Camera(width, height, focal, focal, width / 2, height / 2, pose) for pose in layout.poses()]


def split_of(index: int) -> str:
    return "test" if index % 2 else "train"


def _places() -> list[tuple[float, float]]:
    """(across, down) of each view, both from -0.5 to 0.5."""
    return [(i / (COLUMNS - 1) - 0.5, j / (ROWS - 1) - 0.5) for j in range(ROWS) for i in range(COLUMNS)]
