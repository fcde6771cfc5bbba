"""Pictures and cameras that the output tests share."""

import os
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sehdr_warp.model.light_shapes import LightShape
from sehdr_warp.model.lights import Light, ReceivedLight
from sehdr_warp.model.renders import RenderedView
from sehdr_warp.runs.run import load_splats
from sehdr_warp.scene import Camera, Scene, View, codes_of, look_at
from sehdr_warp.scene.dataparser import PlacedPhoto
from sehdr_warp.scene.images.hdr_files import read_exr_channels
from sehdr_warp.scene.wide_camera import pixel_rays
from sehdr_warp.splats import GaussianArrays, write_gaussians


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
    placed: PlacedPhoto | None = None


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
        rays = pixel_rays(view) @ view.world_to_camera[:3, :3]
        rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-9)
        hdr = self.gain * np.exp(6 * rays - 2 * rays[..., :1]) * 0.1
        rendered = rendered_view(hdr, np.full(x.shape, 0.75), 2 + x * 0 + y * 1e-4)
        return replace(rendered, **{name: getattr(self, f"render_{name}")(view) for name in data})


def read_exr(path):
    """The first part of a file: pixels [H, W, C] float32 as stored, channel names (R, G, B, A first) and the header."""
    channels, header = read_exr_channels(path)
    names = tuple(sorted(channels, key=lambda name: ("RGBA".find(name) % 5, name)))
    return np.stack([channels[name] for name in names], axis=2), names, header


def splats(means, opacities, scale=0.1):
    """Grey Gaussians of display colors."""
    count = len(means)
    opacities = np.asarray(opacities, np.float64)
    return GaussianArrays(
        means=np.asarray(means, np.float32),
        log_scales=np.full((count, 3), np.log(scale), np.float32),
        quaternions=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        opacity_logits=np.log(opacities / (1 - opacities)).astype(np.float32),
        harmonics=np.full((count, 1, 3), 0.5, np.float32),
        color_model="display",
        base_time=1.0,
    )


def run_of(tmp_path, gaussians, name="s"):
    write_gaussians(tmp_path / f"{name}.ply", gaussians)
    run = load_splats(tmp_path / f"{name}.ply")
    run.cameras = tuple(Entry(str(i), "train", camera(position=(i - 1, 0, -6))) for i in range(3))
    return run


def arc(count, degrees, radius=3.0, height=-0.5):
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, count, endpoint=degrees < 360))
    return [camera(position=(radius * np.sin(a), height, -radius * np.cos(a))) for a in angles]


def sees(view, point):
    x, y, z, _ = view.world_to_camera @ np.append(point, 1)
    return view.fx * x / z + view.cx, view.fy * y / z + view.cy


AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float32)
LIGHT = np.array([[9, 1, 1], [1, 9, 9], [1, 9, 1], [9, 1, 9], [1, 1, 9], [9, 9, 1]], dtype=np.float32)


def lamps(width=0.15):
    """A lamp on each of the six axes, each of a color of its own."""
    shape = np.full((6, 3), np.log(5 * width), np.float32), np.tile(np.float32([1, 0, 0, 0]), (6, 1))
    harmonics = LIGHT[:, None] / 0.28209479
    return GaussianArrays(5 * AXES, *shape, np.full(6, 5, np.float32), harmonics, "linear", 0.5)


PANEL = LightShape("rect", np.array([1.0, 0.5, 2.0]), np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), (0.4, 0.2))
BALL = LightShape("sphere", np.array([0.0, 0.0, 3.0]), np.eye(3), (0.3, 0.3))
LIGHTS = [
    Light(PANEL, np.array([8.0, 4.0, 2.0]), np.ones(3), 0.4, 0.5, torch.tensor([0])),
    Light(BALL, np.array([3.0, 3.0, 3.0]), np.ones(3), None, 0.2, torch.tensor([1, 2])),
]


def received(place):
    """Return what reaches a place: the first Gaussian of each light gives all of its light."""
    angles, light = torch.zeros(6, dtype=torch.float64), torch.zeros(6, 3, dtype=torch.float64)
    for each in LIGHTS:
        angles[each.members[0]] = each.shape.solid_angle(place)
        light[each.members[0]] = torch.from_numpy(each.radiance * each.shape.solid_angle(place))
    return ReceivedLight(angles, angles, light)


METRICS = [
    {"iteration": 100, "seconds": 1.5, "split": "test", "psnr_ldr": 20.0, "psnr_mu": 18.0},
    {"iteration": 200, "seconds": 3.0, "split": "test", "psnr_ldr": 26.0, "psnr_mu": 25.5},
]


def make(folder, *, truth=True, splits=("train", "test", "test"), metrics=METRICS):
    run = AnalyticRun([(f"v_{i}", split) for i, split in enumerate(splits)])
    run.metrics = lambda: [{"iteration": 1}, *(metrics or ())]
    views = []
    for entry in run.cameras:
        hdr = run.render(entry.camera).hdr.numpy()
        image = run.response.encode(hdr * entry.exposure_time).astype(np.float32)
        known = {"hdr": hdr} if truth else {}
        views.append(View(entry.name, codes_of(image, 16), entry.camera, entry.exposure_time, entry.split, **known))
    return run, Scene("sky", "photos", tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def validate(text):
    """HTML that no parser, and none of the validators that are here, complains about."""
    pytest.importorskip("html5lib").HTMLParser(strict=True).parse(text)
    folders = [
        Path(folder, "vnu-jar/build/dist/vnu.jar") for folder in os.environ.get("NODE_PATH", "").split(os.pathsep)
    ]
    commands = [["tidy", "-q", "-e"], *(["java", "-jar", str(jar), "-"] for jar in folders if jar.is_file())]
    for command in (command for command in commands if shutil.which(command[0])):
        checked = subprocess.run(command, input=text, capture_output=True, text=True)
        assert checked.returncode == 0 and not checked.stderr, checked.stderr


def smooth_run():
    run = AnalyticRun()
    run.gain = 3.0
    return run, [entry.camera.resized(97, 64) for entry in run.cameras]
