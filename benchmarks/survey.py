"""A synthetic survey of any size: a town of coloured blobs, photographed from above along lanes as a drone does.

python -m benchmarks.survey FOLDER --views 400 --device cuda

The truth is a field of Gaussians on ground, roofs and walls, rendered by the package itself; photos, poses and sparse
points are written as a set in the layout of nerfstudio (transforms.json).
"""

import json
import math
from collections import deque
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.parallel import prefetch_map
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera, codes_of, look_at
from sehdr_warp.synth.expose import write_points

from .study import run

TIME = 1 / 500  # Exposure time of the photos, seconds
ASPECT = 0.75
HEIGHT = 4.0  # Height of the flight above the ground
BUILDING, STREET = 1.6, 0.7  # Sizes of the town's grid
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def make_town(count: int, length: float, width: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return [N, 3] points on the surfaces of a town and their log exposures [N, 3]; x in 0..length, y in 0..width."""
    rng = np.random.default_rng(seed)
    pitch = BUILDING + STREET
    columns, rows = math.ceil(length / pitch), math.ceil(width / pitch)
    heights = rng.uniform(0.3, 1.5, (columns, rows)) * (rng.random((columns, rows)) < 0.8)
    tints = rng.uniform(-1.2, 0.2, (columns, rows, 3))
    ground = rng.uniform(0, 1, (int(count * 0.6), 2)) * (length, width)
    cell = np.minimum((ground // pitch).astype(int), (columns - 1, rows - 1))
    inside = ((ground - cell * pitch) < BUILDING).all(1)
    z = np.where(inside, heights[cell[:, 0], cell[:, 1]], 0.0)
    flat = np.column_stack([ground, z])
    flat_tint = np.where((inside & (z > 0))[:, None], tints[cell[:, 0], cell[:, 1]], (-1.6, -1.4, -1.5))
    walls = rng.integers(0, (columns, rows), (count - len(flat), 2))
    side, along, up = rng.integers(0, 4, len(walls)), rng.uniform(0, BUILDING, len(walls)), rng.random(len(walls))
    across = (side % 2) * BUILDING
    offset = np.where((side < 2)[:, None], np.stack([along, across], 1), np.stack([across, along], 1))
    wall = np.column_stack([walls * pitch + offset, up * heights[walls[:, 0], walls[:, 1]]])
    wall_tint = tints[walls[:, 0], walls[:, 1]] - 0.5 - 0.2 * (side[:, None] % 3)
    has_wall = (heights[walls[:, 0], walls[:, 1]] > 0) & (wall[:, 0] < length) & (wall[:, 1] < width)
    points, tint = np.concatenate([flat, wall[has_wall]]), np.concatenate([flat_tint, wall_tint[has_wall]])
    return points, tint + _texture(points, rng)[:, None] * (0.6, 0.5, 0.55)


def _texture(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return [N] in about -1..1: waves of several lengths, as bricks, tiles and stains."""
    value = np.zeros(len(points))
    for octave in range(6):
        for _ in range(3):
            direction = rng.normal(size=3)
            direction *= 2.0**octave * 1.5 / np.linalg.norm(direction)
            value += np.sin(points @ direction + rng.uniform(0, 2 * np.pi)) * 0.8**octave / 4
    return value


def make_field(points: np.ndarray, log_exposures: np.ndarray, area: float, device) -> RadianceField:
    """Make the truth: round Gaussians of the mean distance of the points."""
    count = len(points)
    size = 0.6 * math.sqrt(area / count)
    means = torch.tensor(points, dtype=torch.float32)
    gaussians = Gaussians(
        means,
        torch.full((count, 3), math.log(size)),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        torch.full((count,), 3.0),
        torch.tensor(log_exposures / 0.28209479177387814, dtype=torch.float32)[:, None],
        torch.zeros(count, 0, 3),
    )
    return RadianceField(gaussians, response_by_name("srgb"), base_time=TIME).to(device)


def make_cameras(views: int, size: int, length: float, width: float) -> list[Camera]:
    """Return cameras on lanes along x, which look down, tilted forwards and backwards by turns."""
    lanes = max(1, round(math.sqrt(views * width / length / 2)))
    each = math.ceil(views / lanes)
    height, focal = round(size * ASPECT), 0.9 * size
    cameras = []
    for lane in range(lanes):
        y = width * (lane + 0.5) / lanes
        for step in range(each):
            x, tilt = length * (step + 0.5) / each, 1.2 if step % 2 else -1.2
            pose = look_at((x, y, HEIGHT), (x + tilt, y + 0.3 * (-1) ** lane, 0.0), up=(0.0, 1.0, 0.0))
            cameras.append(Camera(size, height, focal, focal, size / 2, height / 2, pose))
    return cameras[:views]


def write_survey(
    folder: Path,
    /,
    views: int = 400,
    size: int = 640,
    gaussians: int = 2_000_000,
    device: str = "cpu",
    aspect: float = 4.0,
    seed: int = 0,
) -> None:
    """Write photos, poses and points.

    Args:
        folder: of the set.
        views: number of photos.
        size: width of the photos, pixels.
        gaussians: of the truth.
        device: that renders.
        aspect: length of the town over its width. Its area grows with the photos, so that each shows as much.
        seed: of the town.
    """
    area = views * 1.2
    width = math.sqrt(area / aspect)
    length = area / width
    points, log_exposures = make_town(gaussians, length, width, seed)
    field = make_field(points, log_exposures, 2 * area, device)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    cameras = make_cameras(views, size, length, width)
    names = [f"images/photo_{index:05d}.png" for index in range(views)]
    photos = ((255 * field.render_ldr(camera)).round().to(torch.uint8).cpu().numpy() for camera in cameras)

    def save(photo: tuple[str, np.ndarray]) -> None:
        Image.fromarray(photo[1]).save(folder / photo[0], compress_level=1)

    deque(prefetch_map(save, zip(names, photos), ahead=32), maxlen=0)
    frames = [
        {"file_path": name, "transform_matrix": (camera.camera_to_world @ OPENGL).tolist(), "exposure_time": TIME}
        for name, camera in zip(names, cameras)
    ]
    camera = cameras[0]
    subset = np.random.default_rng(seed).permutation(len(points))[: 40 * views]
    colors = codes_of(field.response.encode(np.exp(log_exposures[subset])), 8) / 255
    write_points(folder / "points.ply", points[subset], colors)
    lens = {"w": camera.width, "h": camera.height, "cx": camera.cx, "cy": camera.cy}
    lens |= {"fl_x": camera.fx, "fl_y": camera.fy}
    (folder / "transforms.json").write_text(json.dumps({**lens, "ply_file_path": "points.ply", "frames": frames}))


if __name__ == "__main__":
    run(write_survey)
