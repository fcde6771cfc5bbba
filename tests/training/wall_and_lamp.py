"""Photos of a textured wall with a small white lamp before it: depths are known exactly."""

import numpy as np

from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera, Scene, View, codes_of
from sehdr_warp.scene.camera import look_at

WALL, LAMP, SIZE, HALF = 4.0, 2.5, 64, 0.08  # Depths of wall and lamp, photos' sides in pixels, half the lamp's side


def photographed(light_at, times=(1.0,), response="linear", turn=0.0) -> Scene:
    """Nine views from a square's corners, sides and middle, which look along +z, those beside the middle turned by so
    many radians; light_at: of positions [3] and directions [H, W, 3], gives light; times: seconds, in turn."""
    curve, views = response_by_name(response), []
    for index, (x, y) in enumerate((x, y) for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)):
        ahead = (x + turn * np.sign(x), y + turn * np.sign(y), 1)
        camera = Camera(SIZE, SIZE, 70.0, 70.0, SIZE / 2, SIZE / 2, look_at((x, y, 0), ahead, (0, -1, 0)))
        column, row = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
        rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(column)], -1)
        time = times[index % len(times)]
        light = light_at(np.array([x, y, 0.0]), rays @ camera.world_to_camera[:3, :3]) * time
        codes = codes_of(np.asarray(curve.encode(np.clip(light, 0, 1))), 8)
        views.append(View(f"v_{index}", codes, camera, time, "train"))
    return Scene("by hand", "hand-made", tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def texture(places) -> np.ndarray:
    """[H, W, 3] smooth waves around 0.3 over places [H, W, 2]."""
    rng, light = np.random.default_rng(0), np.zeros((*places.shape[:2], 3))
    for a, b, phase, *offsets in [(*rng.uniform(2, 14, 2), *rng.uniform(0, 7, 4)) for _ in range(12)]:
        light += np.sin(a * places[..., :1] + b * places[..., 1:2] + phase) * np.sin(offsets)
    return 0.3 + 0.05 * light


def in_lamp(position, rays) -> np.ndarray:
    """[H, W] which rays meet the lamp."""
    return (np.abs(position[:2] + rays[..., :2] / rays[..., 2:] * LAMP) < HALF).all(-1)


def wall_and_lamp(times=(1.0,), response="linear") -> Scene:
    """A textured wall and a white lamp before it."""

    def light_at(position, rays):
        light = texture(position[:2] + rays[..., :2] / rays[..., 2:] * WALL)
        return np.where(in_lamp(position, rays)[..., None], 1e3, light)

    return photographed(light_at, times, response)
