"""Where the 35 views stand: HDR-NeRF's forward-facing grid, or a wide arc. Meters, z up."""

import math
from dataclasses import dataclass

import numpy as np

from ..scene import Camera, look_at

COLUMNS, ROWS = 7, 5
VIEWS = COLUMNS * ROWS
"""HDR-NeRF's number of views; the even ones train (18), the odd ones test (17)."""
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
