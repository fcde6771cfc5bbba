"""A synthetic scene with photos, at any number of points and any size, to time training steps on."""

import numpy as np
import torch

from ..field.gaussians import Gaussians
from ..field.radiance_field import RadianceField
from ..response import response_by_name
from ..scene import Camera, Scene, View, codes_of, look_at
from .splats import Size

EXPOSURE_TIME = 0.25
BALLS = 24


def make_photo_scene(size: Size, views: int = 18, device: str | torch.device = "cpu") -> Scene:
    """Photos, all for training, of coloured balls on a floor, from a circle around them; 8 bit, sRGB.

    size.gaussians points lie on the surfaces, as those of a trained scene do; the photos show them as Gaussians, so
    some pixels are clipped and some black. device: where they are rendered.
    """
    rng = np.random.default_rng(0)
    points, log_exposure = _surfaces(size.gaussians, rng)
    response = response_by_name("srgb")
    gaussians = Gaussians.from_points(
        torch.tensor(points, dtype=torch.float32, device=device),
        torch.tensor(log_exposure, dtype=torch.float32, device=device),
        0,
        opacity=0.9,
    )
    field = RadianceField(gaussians, response, base_time=EXPOSURE_TIME)
    photos = []
    for index in range(views):
        camera = _camera(2 * np.pi * index / views, size)
        photo = np.round(field.render_ldr(camera).cpu().numpy() * 255) / 255
        photos.append(View(f"v_{index}", codes_of(photo, 8), camera, EXPOSURE_TIME, "train"))
    colours = np.asarray(response.encode(np.exp(log_exposure)), dtype=np.float32)
    return Scene(f"synthetic {size}", "transforms", tuple(photos), points, colours)


def _surfaces(count: int, rng) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] on balls and on the floor z = 0, and their log exposures [N, 3] over some six stops."""
    centres = np.concatenate([rng.uniform(-1.2, 1.2, (BALLS, 2)), rng.uniform(0.2, 1.0, (BALLS, 1))], axis=1)
    radii, tints = rng.uniform(0.1, 0.35, BALLS), rng.uniform(-3.5, 0.5, (BALLS + 1, 3))
    which = rng.integers(0, BALLS + 8, count).clip(max=BALLS)
    on_floor = which == BALLS
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ball = np.where(on_floor, 0, which)
    points = centres[ball] + radii[ball, None] * direction
    points[on_floor] = np.concatenate([rng.uniform(-2, 2, (on_floor.sum(), 2)), np.zeros((on_floor.sum(), 1))], axis=1)
    shade = 0.4 * np.sin(9 * points).sum(axis=1, keepdims=True)
    return points, tints[which] + shade


def _camera(angle: float, size: Size, radius: float = 3.5) -> Camera:
    """On a circle at height 1.6, looking at the middle of the balls."""
    pose = look_at([radius * np.cos(angle), radius * np.sin(angle), 1.6], (0.0, 0.0, 0.4))
    focal = 1.1 * size.width
    return Camera(size.width, size.height, focal, focal, size.width / 2, size.height / 2, pose)
