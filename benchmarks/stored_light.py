"""The light of a training at the places of its scene's maps: by directions, and as lights with a map of the rest."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.irradiance import LightMap, rendered_map, typical_focal
from sehdr_warp.errors import InputError
from sehdr_warp.model.lights import LightShape
from sehdr_warp.scene import Camera

LIGHT = "light.npz"
"""File of a job's folder."""


@dataclass(frozen=True, eq=False)
class StoredLight:
    """Light of a training at the places of its scene's maps, in the truth's unit.

    maps: [H, W, 3] of each place. rest: the same without the lights; empty if the run does not state what clipped.
    lights: shapes in the scene's coordinates, each with its radiance [3].
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
        for light in lights:
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
