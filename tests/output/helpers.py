"""Pictures and cameras that the output tests share."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from sehdr_warp.model.renders import RenderedView
from sehdr_warp.scene import Camera, look_at
from sehdr_warp.scene.images.hdr_files import read_exr_channels


def radiance(height=24, width=32, seed=0):
    """[H, W, 3] float32 over five decades."""
    random = np.random.default_rng(seed)
    return (10.0 ** random.uniform(-3, 2, (height, width, 3))).astype(np.float32)


def camera(width=32, height=24, position=(0.0, 0.0, -3.0), target=(0.0, 0.0, 0.0)):
    """A camera that looks at a target, y down."""
    return Camera(width, height, 40.0, 44.0, width / 2 + 1, height / 2 - 2, look_at(position, target, up=(0, -1, 0)))


@dataclass
class Entry:
    name: str
    split: str
    camera: Camera
    exposure_time: float = 0.5


def rendered_view(*images):
    return RenderedView(*(torch.tensor(image, dtype=torch.float32) for image in images))


class GammaResponse:
    """Clips at 1, gamma 2.2; no torch needed."""

    name, white = "gamma-2.2", 1.0

    def encode(self, exposure):
        return np.clip(exposure, 0, 1) ** (1 / 2.2)

    def decode(self, value):
        return np.clip(value, 0, 1) ** 2.2


class AnalyticRun:
    """Stands for a trained run: a sky whose radiance depends on the viewing direction, six decades of it."""

    world_matrix = up = reference = None

    response = GammaResponse()
    base_time, color_matrix, exposure_compensation = 0.5, None, None
    scene_name = "sky"
    iterations = 7
    gaussian_count, train_seconds, path = 1234, 65.0, "runs/sky"

    def __init__(self, names=(("r_0", "train"), ("r_1", "train"), ("r_2", "train"), ("t_0", "test"), ("t_1", "test"))):
        self.cameras = [
            Entry(name, split, camera(position=(0.3 * i - 0.6, 0.1 * (i % 2), -3)))
            for i, (name, split) in enumerate(names)
        ]
        self.gain, self.confident = 1.0, True
        self.rendered = 0

    def normalize_photos(self, scene):
        return scene

    def summary(self):
        return {"device": "abacus"}

    def notes(self):
        return ["a note of `the training`"]

    def decisions(self):
        return []

    def metrics(self):
        return []

    def render_confidence(self, view):
        """Falls from left to right, and from 1; none where it is switched off."""
        if not self.confident:
            return None
        return torch.linspace(1, 0, view.width).expand(view.height, -1)

    def render_clipped(self, view):
        return torch.full((view.height, view.width), 0.25) if self.confident else None

    def clipped_share(self):
        return None

    def render(self, view, *, supersample=True, data=()):
        self.rendered += 1
        y, x = np.mgrid[: view.height, : view.width] + 0.5
        rays = (
            np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones_like(x)], 2)
            @ view.world_to_camera[:3, :3]
        )
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        hdr = self.gain * np.exp(6 * rays - 2 * rays[..., :1]) * 0.1
        rendered = rendered_view(hdr, np.full(x.shape, 0.75), 2 + x * 0 + y * 1e-4)
        return replace(rendered, **{name: getattr(self, f"render_{name}")(view) for name in data})


def read_exr(path):
    """The first part of a file: pixels [H, W, C] float32 as stored, channel names (R, G, B, A first) and the header."""
    channels, header = read_exr_channels(path)
    names = tuple(sorted(channels, key=lambda name: ("RGBA".find(name) % 5, name)))
    return np.stack([channels[name] for name in names], axis=2), names, header
