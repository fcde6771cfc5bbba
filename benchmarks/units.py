"""One scene in worlds of other units and origins: a training must not depend on either.

    python -m benchmarks.units --json docs/reports/results/units.json --device cpu

The embedded room as it is, 16 times as large, a hundredth as large, and in UTM coordinates; the same seed and plan.
"""

import logging
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene import Scene, load_scene
from sehdr_warp.training.train import train

from .results import finish, new_result
from .study import run

LOG = logging.getLogger("units")
FAR = 30  # Units of the normalized world: beyond them a Gaussian of a room is astray


class World(NamedTuple):
    """A world that the scene is brought to: its unit and where its origin goes."""

    name: str
    scale: float
    origin: tuple[float, float, float]


WORLDS = (
    World("as it is", 1.0, (0, 0, 0)),
    World("times 16", 16.0, (0, 0, 0)),
    World("times 0.01", 0.01, (0, 0, 0)),
    World("UTM", 1.0, (500_000, 4_200_000, 100)),
)


def main(json: Path, max_size: int = 100, iterations: int = 1500, device: str = "cpu") -> None:
    """Train the embedded room in each world.

    Args:
        json: the file that the result is written to.
        max_size: of the photos' longest side in pixels.
        iterations: of each training.
        device: "cpu", "cuda:0", ...
    """
    result = new_result("units", torch.device(device), {"max_size": max_size, "iterations": iterations})
    scene = load_scene("embedded", max_size=max_size)
    result["rows"] = [measure(scene, world, iterations, device) for world in WORLDS]
    finish(result, json, overwrite=True)


def measure(scene: Scene, world: World, iterations: int, device: str) -> dict:
    """Return what a training in a world reaches, and how far its Gaussians lie."""
    fields = {"schedule.iterations": iterations, "plan.keep": ("schedule.iterations",)}
    with tempfile.TemporaryDirectory() as folder:
        moved = in_world(scene, world)
        run = train(moved, Path(folder) / "run", load_config("default", fields), device=device)
        last, distances = run.metrics()[-1], run.field.gaussians.means.norm(dim=1)
    row = {"world": world.name, "photos": last["psnr_ldr"], "hdr": last["psnr_mu"], "gaussians": run.gaussian_count}
    row |= {"far": float((distances > FAR).float().mean()), "farthest": float(distances.max())}
    LOG.info("%s", row)
    return row


def in_world(scene: Scene, world: World) -> Scene:
    """Return the scene with its cameras and points multiplied and then moved."""
    views = []
    for view in scene.views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ (world.scale * view.camera.position + world.origin)
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    return replace(scene, views=tuple(views), points=world.scale * scene.points + world.origin)


if __name__ == "__main__":
    run(main)
