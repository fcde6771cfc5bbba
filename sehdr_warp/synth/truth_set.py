"""A set of HDR truth in HDR-NeRF's synthetic layout: poses, times, EXR and start points; photos are derived from it.

`transforms_<split>.json` says `"photo_response": "reinhard-gamma"`: load_scene makes the photos of the truth by that
curve at the times of `exposure_<split>.json`, so a set needs no photos of its own.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import atomic_path, write_json
from ..scene import Scene, View, codes_of
from ..scene.capture import DERIVED_PHOTOS, reinhard_gamma
from .expose import exposure_ladder
from .photo_set import RadianceView

START_POINTS = 6000
"""Of a set's points3d.ply; at a point per five pixels and view, as dense as structure from motion gets them."""


class HdrNerfCurve:
    """HDR-NeRF's synthetic response as expose() takes one, without torch."""

    clips, clip_exposure = False, math.inf
    # Where the value is half an 8-bit code below 1.
    white = (1 - 0.5 / 255) ** 2.2 / (1 - (1 - 0.5 / 255) ** 2.2)
    encode = staticmethod(reinhard_gamma)


def truth_path(folder: Path, split: str, place: int) -> Path:
    """The EXR of a split's frame number `place`."""
    return folder / f"{split}_hdr" / f"hdr_{place:03d}.exr"


def write_truth_tables(
    folder: Path, views: Sequence[RadianceView], points: np.ndarray, point_radiance: np.ndarray, extra: dict
) -> tuple[float, ...]:
    """Write all of a set but its EXR files, replacing what is there; returns the five exposure times.

    views: in the order of their files. points: [P, 3] places, point_radiance: [P, 3]; START_POINTS of them are kept,
    drawn with seed 0. extra: what `synth.json` says of the set's making.
    """
    times = exposure_ladder(as_scene(folder.name, views), HdrNerfCurve())
    for split in ("train", "test"):
        chosen = [view for view in views if view.split == split]
        if not chosen:
            continue
        frames, stated = [], {}
        for view in chosen:
            matrix = view.camera.camera_to_world.copy()
            matrix[:3, 1:3] *= -1  # To OpenGL's axes.
            frames.append({"file_path": f"./{split}/{view.name}", "transform_matrix": matrix.tolist()})
            stated |= {f"./{split}/{view.name}_{k}.png": time for k, time in enumerate(times)}
        camera = chosen[0].camera
        angle = 2 * math.atan(0.5 * camera.width / camera.fx)
        head = {"camera_angle_x": angle, "w": camera.width, "h": camera.height, "photo_response": DERIVED_PHOTOS}
        write_json(folder / f"transforms_{split}.json", head | {"frames": frames}, overwrite=True)
        write_json(folder / f"exposure_{split}.json", stated, overwrite=True)
    keep = np.random.default_rng(0).permutation(len(points))[:START_POINTS]
    _write_points(folder / "points3d.ply", points[keep], reinhard_gamma(point_radiance[keep] * times[len(times) // 2]))
    write_json(folder / "synth.json", extra, overwrite=True)
    return times


def as_scene(name: str, views: Sequence[RadianceView]) -> Scene:
    """Truth as a Scene whose photos are HDR-NeRF's at 1 second, for expose and exposure_ladder."""
    made = tuple(
        View(
            view.name,
            codes_of(reinhard_gamma(view.radiance), 16),
            view.camera,
            1.0,
            view.split,
            hdr=np.asarray(view.radiance, np.float32),
        )
        for view in views
    )
    return Scene(name, "hdr-nerf", made, np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def read_making(folder: Path) -> dict:
    """A set's synth.json; InputError where it is damaged, {} where there is none."""
    path = folder / "synth.json"
    if not path.is_file():
        return {}
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(path, f"cannot be read ({error})", "render the scene again") from None
    return values if isinstance(values, dict) else {}


def _write_points(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    from plyfile import PlyData, PlyElement

    kinds = [(axis, "f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(points), kinds)
    for axis, values in zip("xyz", points.T, strict=True):
        vertices[axis] = values
    codes = np.clip(np.round(colours * 255), 0, 255).astype(np.uint8)
    for name, values in zip(("red", "green", "blue"), codes.T, strict=True):
        vertices[name] = values
    with atomic_path(path, overwrite=True) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")]).write(str(temporary))
