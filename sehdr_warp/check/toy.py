"""A scene of a few small photos, for short trainings."""

from functools import cache

import numpy as np
import torch

from ..field.gaussians import Gaussians
from ..field.radiance_field import RadianceField
from ..response import response_by_name
from ..scene import Camera, Scene, View, codes_of, look_at

SIZE, VIEWS, EXPOSURE_TIME = 32, 6, 0.25


def toy_field(device="cpu", base_time: float = EXPOSURE_TIME) -> RadianceField:
    """A cloud of 60 blobs whose exposures span four stops."""
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(60, 3, generator=generator) * 2 - 1
    logs = torch.rand(60, 3, generator=generator) * 3.3 - 3.0
    gaussians = Gaussians.from_points(points, logs, 0, opacity=0.9, scale=0.6)
    return RadianceField(gaussians, response_by_name("srgb"), base_time=base_time).to(device)


@cache
def toy_scene(clipped: float = 0.0) -> Scene:
    """8-bit photos of toy_field() from a circle around it. clipped: this share of each photo's rows is white."""
    field, views = toy_field(), []
    for index in range(VIEWS):
        camera = _orbit(2 * np.pi * index / VIEWS)
        photo = np.round(field.render_ldr(camera).numpy() * 255) / 255
        photo[: round(clipped * SIZE)] = 1.0
        views.append(View(f"v_{index}", codes_of(photo, 8), camera, EXPOSURE_TIME, "train"))
    points = field.gaussians.means.detach().numpy().astype(np.float64)
    return Scene("toy", "transforms", tuple(views), points, np.full((len(points), 3), 0.5, np.float32))


def _orbit(angle: float) -> Camera:
    pose = look_at([4 * np.cos(angle), 4 * np.sin(angle), 0.8])
    return Camera(SIZE, SIZE, 1.2 * SIZE, 1.2 * SIZE, SIZE / 2, SIZE / 2, pose)
