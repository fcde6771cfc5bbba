"""The light of a trained scene at the places of its maps: errors of irradiance, and what a job stores of it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.model.baking import sphere_directions
from sehdr_warp.model.light_shapes import LightShape
from sehdr_warp.output.lighting.environment_map import latlong, solid_angles
from sehdr_warp.output.lighting.lights import lights_as_received
from sehdr_warp.output.lighting.map_center import MapCenter
from sehdr_warp.scene import Camera
from sehdr_warp.scene.images.hdr_files import read_exr_channels

FOLDER = "light"
LIGHT = "light.npz"  # File of a job's folder
NORMALS = 200  # Directions that surfaces face, evenly over the sphere
LEAST_SEEN = 0.1  # A surface counts if photos show this part of its hemisphere, weighted by the cosine
FINER, FINEST = 4, 32
"""Least and most pixels of a render, across, for one of the truth's. Pixels as fine as the photos' are needed: in
larger ones small Gaussians no longer hide each other, and a small lamp of several came out twice as bright."""


@dataclass(frozen=True, eq=False)
class LightMap:
    """The true light of a place."""

    position: np.ndarray  # [3] in the scene
    radiance: np.ndarray  # [H, 2 H, 3], lat-long in the scene's axes (see output.environment_map)
    coverage: np.ndarray  # [H, 2 H] in [0, 1], the part of a pixel that photos show


def read_light_maps(folder: Path) -> list[LightMap]:
    """Read the maps in a set's folder `light`, which scenes.generator writes; none if there is no such folder.

    Raises InputError for a file that is not such a map.
    """
    maps = []
    for path in sorted((folder / FOLDER).glob("*.exr")):
        channels, header = read_exr_channels(path)
        height, width = next(iter(channels.values())).shape
        try:
            position = np.array(json.loads(header["sehdr:position"]), float).reshape(3)
            radiance, coverage = np.stack([channels[name] for name in "RGB"], axis=2), channels["A"]
        except (LookupError, ValueError, TypeError):
            position, radiance, coverage = np.full(3, np.nan), np.zeros(0), np.zeros(0)
        if width != 2 * height or not np.isfinite(position).all() or not np.isfinite(radiance).all():
            problem = "is no lat-long map with R, G, B, A and sehdr:position"
            raise InputError(path, problem, f"remove it, or make {FOLDER}/ again by scenes.generator")
        maps.append(LightMap(position, radiance, coverage))
    return maps


@torch.no_grad()
def irradiance_error(run: Any, maps: Sequence[LightMap], cameras: Sequence[Camera], scale: float = 1.0) -> float | None:
    """Return the median relative error of irradiance over all directions of all places.

    Light is the mean over channels, and only that which photos show: render and truth are multiplied by `coverage`.
    Surfaces that face too little of it do not count.

    Args:
        run: the loaded run.
        maps: the true light of each place.
        cameras: those of the training.
        scale: from the run's radiance to the truth's.

    Returns:
        The error; None without maps or directions that count.
    """
    focal = typical_focal(cameras)
    errors = np.concatenate([*(_errors(run, each, focal, scale) for each in maps), np.zeros(0)])
    return float(np.median(errors)) if len(errors) else None


@torch.no_grad()
def rendered_map(run: Any, truth: LightMap, focal: float, without: Sequence[torch.Tensor] = ()) -> np.ndarray:
    """Return [H, W, 3] radiance of a run at the place and in the pixels of a map of the truth.

    focal: pixels, of the training cameras. without: groups of Gaussians that give no light.
    """
    height, width = truth.coverage.shape
    finer = int(np.clip(np.ceil(2 * np.pi * focal / width), FINER, FINEST))
    fine = finer * width
    options: dict[str, Any] = {"focal_length": focal, "pixel_angle": 2 * np.pi / fine}
    options |= {"without": without} if without else {}
    light = run.render_directions(truth.position, latlong(fine), **options).hdr.cpu().numpy()
    return light.reshape(height, finer, width, finer, 3).mean(axis=(1, 3))


def typical_focal(cameras: Sequence[Camera]) -> float:
    """Return the median focal length of cameras, in pixels; 1 without cameras."""
    return float(np.median([np.sqrt(camera.fx * camera.fy) for camera in cameras])) if cameras else 1.0


def _errors(run: Any, truth: LightMap, focal: float, scale: float) -> np.ndarray:
    width = truth.coverage.shape[1]
    light = scale * rendered_map(run, truth, focal).mean(2)
    weight = truth.coverage * solid_angles(width, "latlong")
    facing = np.maximum(sphere_directions(NORMALS) @ latlong(width).reshape(-1, 3).T, 0)
    rendered, true, coverage = (facing @ (each * weight).ravel() for each in (light, truth.radiance.mean(2), 1.0))
    covered = coverage > LEAST_SEEN * (facing @ solid_angles(width, "latlong").ravel())
    return np.abs(rendered[covered] / np.maximum(true[covered], np.finfo(np.float32).tiny) - 1)


@dataclass(frozen=True, eq=False)
class StoredLight:
    """Light of a training at the places of its scene's maps, in the truth's unit.

    maps: [H, W, 3] of each place. rest: the same without the lights; empty if the run does not state what clipped.
    lights: shapes in the scene's coordinates, each with its radiance [3] for the first place.
    """

    maps: list[np.ndarray]
    rest: list[np.ndarray]
    lights: list[tuple[LightShape, np.ndarray]]


def store_light(path: Path, run: Any, maps: Sequence[LightMap], cameras: Sequence[Camera], scale: float) -> None:
    """Write the light of a run at the places of maps; nothing without maps.

    cameras: the training's. scale: of the run's radiance to the truth's.
    """
    if not maps:
        return
    focal = typical_focal(cameras)
    arrays = {f"map_{i}": scale * rendered_map(run, each, focal) for i, each in enumerate(maps)}
    rows = []
    if run.clipped_share() is not None:
        lights = run.find_lights()
        members = [light.members for light in lights]
        arrays |= {f"rest_{i}": scale * rendered_map(run, each, focal, members) for i, each in enumerate(maps)}
        for light in lights_as_received(run, lights, MapCenter(maps[0].position, 0.0)):
            shape = {"kind": light.shape.kind, "position": light.shape.position.tolist(), "size": light.shape.size}
            radiance = (scale * np.asarray(light.radiance, float)).tolist()
            rows.append(shape | {"axes": light.shape.axes.tolist(), "radiance": radiance})
    packed: dict[str, Any] = {name: array.astype(np.float32) for name, array in arrays.items()}
    np.savez_compressed(path, lights=np.array(json.dumps(rows)), **packed)


def read_light(path: Path) -> StoredLight:
    """Return what store_light() wrote; raise InputError for another file."""
    try:
        with np.load(path) as arrays:
            count = range(len(arrays))
            lists = {n: [arrays[f"{n}_{i}"] for i in count if f"{n}_{i}" in arrays] for n in ("map", "rest")}
            rows = json.loads(str(arrays["lights"]))
        lights = [
            (
                LightShape(row["kind"], np.array(row["position"]), np.array(row["axes"]), tuple(row["size"])),
                np.array(row["radiance"]),
            )
            for row in rows
        ]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(path, f"is not the light of a job ({error!s:.100})", "run the job again") from None
    return StoredLight(lists["map"], lists["rest"], lights)
