"""A scene of a few small views of a coloured cloud, with HDR truth, made by the package's own renderer."""

from dataclasses import replace

import numpy as np
import torch

from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import REFERENCE_ITERATIONS, Config
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene import Camera, Scene, View, codes_of, look_at
from sehdr_warp.training.initialization import make_field, response_for_training
from sehdr_warp.training.trainer import Trainer

EXPOSURE_TIME = 0.25
NUMBERS = (
    *(f"densification.{name}" for name in ("refine_start_iter", "refine_stop_iter", "refine_every")),
    "adc.reset_every",
    *(f"schedule.{name}" for name in ("sh_degree_interval", "evaluate_at", "checkpoint_every")),
)
"""The fields of a config that are iteration numbers."""


def orbit_camera(angle: float, size: int = 32, radius: float = 4.0) -> Camera:
    """A camera on a circle in the plane z = 0.8, looking at the origin."""
    pose = look_at([radius * np.cos(angle), radius * np.sin(angle), 0.8])
    return Camera(size, size, 1.2 * size, 1.2 * size, size / 2, size / 2, pose)


def toy_field(count: int = 60, seed: int = 3) -> RadianceField:
    """A cloud of coloured blobs whose radiance spans some four stops around a mid exposure."""
    rng = np.random.default_rng(seed)
    points = torch.tensor(rng.uniform(-1, 1, (count, 3)), dtype=torch.float32)
    log_exposure = torch.tensor(rng.uniform(-3.0, 0.3, (count, 3)), dtype=torch.float32)
    gaussians = Gaussians.from_points(points, log_exposure, 0, opacity=0.9, scale=0.6)
    return RadianceField(gaussians, response_by_name("srgb"), base_time=EXPOSURE_TIME)


def toy_scene(view_count: int = 8, size: int = 32, with_points: bool = True) -> Scene:
    """8-bit photos of toy_field(); every fourth view is held out."""
    field = toy_field()
    views = []
    for index in range(view_count):
        camera = orbit_camera(2 * np.pi * index / view_count, size)
        photo = np.round(field.render_ldr(camera).numpy() * 255) / 255
        truth = field.render(camera).hdr.numpy()
        split = "test" if index % 4 == 3 else "train"
        views.append(View(f"v_{index}", codes_of(photo, 8), camera, EXPOSURE_TIME, split, hdr=truth))
    points = field.gaussians.means.detach().numpy().astype(np.float64)
    colors = np.full((len(points), 3), 0.5, dtype=np.float32)
    chosen = slice(None) if with_points else slice(0)
    return Scene("toy", "transforms", tuple(views), points[chosen], colors[chosen])


def make_trainer(scene: Scene, config: Config, device: str = "cpu") -> Trainer:
    """A trainer of a new field of the scene."""
    return Trainer(scene, config, make_field(scene, config, response_for_training(scene, config), device))


def stated(iteration: float, iterations: int) -> int:
    """The number to write in a config of so many iterations for what is to happen at an iteration of its own."""
    return max(1, round(iteration * REFERENCE_ITERATIONS / iterations))


def load_unscaled(preset: str = "default", overrides: dict | None = None, length: int | None = None) -> Config:
    """load_config without a plan, with iteration numbers as they stand in a training of `length` iterations, by default
    its own."""
    fields = {"plan.enabled": False} | (overrides or {})
    plain = load_config(preset).model_dump()
    iterations = length or fields.get("schedule.iterations", plain["schedule"]["iterations"])
    for path in NUMBERS:
        part, name = path.split(".")
        value = fields.get(path, plain[part][name])
        many = isinstance(value, list | tuple)
        fields[path] = [stated(n, iterations) for n in value] if many else stated(value, iterations)
    return load_config(preset, fields)


QUICK = {
    # That of the toy scene: what a training makes of a wrong one is not its fault.
    "response.name": "srgb",
    "schedule.sh_degree_interval": 40,
    "schedule.evaluate_at": [10],
    "schedule.checkpoint_every": 60,
    "densification.refine_start_iter": 20,
    "densification.refine_stop_iter": 80,
    "densification.refine_every": 25,
    "densification.cap_max": 400,
    "model.sh_degree": 1,
    "optimizer.means": 1e-3,
    "model.initial_density": 2.0,
}
PAPER = {"optimizer.harmonics_dc": 0.05, "optimizer.fusion": 0.01}
TONE = {"optimizer.harmonics_dc": 0.02, "optimizer.response": 0.005}


def quick(preset: str = "default", length: int = 90, **options) -> Config:
    """A training of `length` iterations: counts change at 25, 50 and 75, a checkpoint is at 60."""
    learned = {"response.name": "learned"} if load_config(preset).response.name == "learned" else {}
    fixed = {"schedule.iterations": length}
    return load_unscaled(preset, QUICK | fixed | learned | options, length=length)


VARIANTS = {
    "default": quick(),
    "adc": quick(**{"densification.strategy": "adc", "loss.opacity_weight": 0.0, "loss.size_weight": 0.0}),
    "3dgs": quick("3dgs", **{"optimizer.harmonics_dc": 0.01}),
    "dropout": quick(**{"model.dropout": 0.5}),
    "paper": quick("paper", 130, **PAPER),
    "paper-truth": quick("paper-truth", 150, **PAPER),
    "linear truth": quick(**{"loss.linear_weight": 0.5, "loss.hdr_truth": True}),
    "truth": quick("truth"),
    "gaussian tone map": quick(**{"model.tone_map": "gaussian"}),
    "hdr-gs": quick("hdr-gs", **TONE),
    "hdr-gs-truth": quick("hdr-gs-truth", **TONE),
    "gauss-hdr": quick("gauss-hdr", 220, **TONE),
}
"""Short trainings of all kinds, which the fixture `trained` makes."""


def without_truth(scene: Scene, *names: str) -> Scene:
    """The scene without the truth of the training views, or of those named alone."""
    views = (
        replace(view, hdr=None) if view.split == "train" and (not names or view.name in names) else view
        for view in scene.views
    )
    return replace(scene, views=tuple(views))


def with_smaller_photos(scene: Scene, part: float) -> Scene:
    """Return a scene of square photos whose every second view has a part of its resolution."""

    def smaller(view: View) -> View:
        size = round(part * view.camera.width)
        return replace(view, camera=view.camera.resized(size, size), codes=view.codes[:size, :size], hdr=None)

    views = tuple(smaller(view) if index % 2 else view for index, view in enumerate(scene.views))
    return replace(scene, views=views)
