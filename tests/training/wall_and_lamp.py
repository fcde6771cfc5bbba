"""Photos of a textured wall with a small white lamp before it: depths are known exactly."""

import numpy as np

from sehdr_warp.scene import Camera, Scene, View, codes_of
from sehdr_warp.scene.camera import look_at

WALL, LAMP, SIZE, HALF = 4.0, 2.5, 64, 0.08
"""Depths of wall and lamp, photos' sides in pixels, half the lamp's side."""


def wall_and_lamp(times=(1.0,)) -> Scene:
    """Nine views; times: seconds, taken in turn."""
    rng = np.random.default_rng(0)
    waves = [(*rng.uniform(2, 14, 2), *rng.uniform(0, 7, 4)) for _ in range(12)]
    views = []
    for index, (x, y) in enumerate((x, y) for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)):
        camera = Camera(SIZE, SIZE, 70.0, 70.0, SIZE / 2, SIZE / 2, look_at((x, y, 0), (x, y, 1), (0, -1, 0)))
        column, row = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
        rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(column)], -1)
        rays = rays @ camera.world_to_camera[:3, :3]
        wall, lamp = (np.array([x, y]) + rays[..., :2] * depth for depth in (WALL, LAMP))
        light = np.zeros((SIZE, SIZE, 3))
        for a, b, phase, *offsets in waves:
            wave = np.sin(a * wall[..., 0] + b * wall[..., 1] + phase)
            light += np.stack([np.roll(wave, 0) * np.sin(offset) for offset in offsets], -1)
        light = 0.3 + 0.05 * light
        light[(np.abs(lamp) < HALF).all(-1)] = 1e3
        time = times[index % len(times)]
        codes = codes_of(np.clip(light * time, 0, 1), 8)
        views.append(View(f"v_{index}", codes, camera, time, "train"))
    return Scene("wall and lamp", "hand-made", tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.float32))
