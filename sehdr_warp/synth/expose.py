"""Photos of HDR truth (exposure, sensor noise, response, quantization), and sets of them in HDR-NeRF's layout."""

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured
from PIL import Image

from ..errors import InputError
from ..files import atomic_folder, atomic_path, write_json
from ..output.images.exr import write_exr
from ..parallel import prefetch_map
from ..response import Response
from ..scene import Camera, Scene, View, codes_of
from ..subsets import every_nth
from .glare import add_glare

_MOST_SAMPLES, _STEPS_PER_STOP = 200_000, 16


@dataclass(frozen=True)
class SensorNoise:
    """Shot noise and read noise of a linear sensor, in electrons."""

    full_well: float = 20_000.0  # At the response's clip_exposure; of a curve that only nears its peak, at its white
    read_noise: float = 5.0  # Standard deviation

    def __post_init__(self):
        """Check the figures."""
        if not 1.0 <= self.full_well < 1e12:
            raise InputError("sensor noise", f"full well of {self.full_well:g} electrons", "give 1 to 1e12")
        if not 0.0 <= self.read_noise < 1e9:
            raise InputError("sensor noise", f"read noise of {self.read_noise:g} electrons", "give 0 or more")


@dataclass(frozen=True)
class RadianceView:
    """A view of HDR truth."""

    name: str  # The view's stem (`r_0`)
    camera: Camera  # Its camera
    radiance: np.ndarray  # [H, W, 3] scene-linear, at least 0
    split: str  # "train" or "test"


def expose(
    scene: Scene,
    response: Response,
    exposure_time: float,
    *,
    glare: float = 0.0,
    noise: SensorNoise | None = None,
    seed: int = 0,
) -> Scene:
    """Expose the truth of a scene: each photo becomes response.encode(hdr * exposure_time), rounded to 8 bits.

    Each point takes its new color from the training view whose old photo is nearest to the point's old color, which
    most likely shows it unoccluded; a point outside of all training views keeps its color.

    Args:
        scene: every view has truth (View.hdr).
        response: encodes exposures.
        exposure_time: seconds.
        glare: the lens's veiling glare index in percent, see add_glare(); truth stays without it.
        noise: applied to the exposure before the response, sampled for each view from (seed, its name).
        seed: of the noise.

    Raises:
        InputError: for a view without truth or an impossible time, or as add_glare().
    """
    if not (math.isfinite(exposure_time) and exposure_time > 0):
        raise InputError(scene.name, f"exposure time {exposure_time:g} s is not positive and finite", "give seconds")
    views = []
    for view in scene.views:
        # Colors beyond Rec.709 have negative parts, which no sensor counts.
        exposure = add_glare(np.maximum(_truth(scene, view).astype(np.float64), 0), glare) * exposure_time
        if noise is not None:
            rng = np.random.default_rng([seed, zlib.crc32(view.name.encode())])
            exposure = noisy(exposure, response.clip_exposure if response.clips else response.white, noise, rng)
        views.append(replace(view, codes=codes_of(response.encode(exposure), 8), exposure_time=float(exposure_time)))
    fields = {"views": tuple(views), "point_colors": _recolor(scene, views), "exposure_times_known": True}
    return replace(scene, **fields, response=None, chosen_by=None)


def exposure_ladder(scene: Scene, response: Response, count: int = 5, factor: float = 4.0) -> tuple[float, ...]:
    """Return ladder_of() the truth of the training views; raise InputError if a view has no truth."""
    truth = [_truth(scene, view) for view in scene.train_views]
    return ladder_of(scene.name, truth, response.encode, count, factor)


def ladder_of(
    name: str, images: Sequence[np.ndarray], encode: Callable[[Any], np.ndarray], count: int = 5, factor: float = 4.0
) -> tuple[float, ...]:
    """Return `count` exposure times, each `factor` times the last, around a well exposed one of radiance images.

    Their geometric middle maximizes the mean well-exposedness exp(-(Z - 0.5)^2 / (2 * 0.2^2)) of the encoded values Z
    (Mertens et al. 2007, "Exposure Fusion"), to a sixteenth of a stop.

    Raises:
        InputError: with the name, if all is black.
    """
    radiance = np.concatenate([image.ravel() for image in images])
    radiance = every_nth(radiance, _MOST_SAMPLES).astype(np.float64)
    lit = radiance[radiance > 0]
    if not len(lit):
        raise InputError(name, "the truth of the training views is black", "render it with light")

    def well_exposedness(stop: float) -> float:
        return float(np.exp(-0.5 * ((encode(radiance * 2.0**stop) - 0.5) / 0.2) ** 2).mean())

    low, high = (np.log2(np.percentile(lit, share)) for share in (1, 99))
    # From the brightest parts at black to the darkest at white; two stops of light are well exposed, so that no peak
    # lies between every eighth step.
    stops = np.arange(-high - 12, -low + 12, 1 / _STEPS_PER_STOP)
    near = 8 * max(range(len(stops[::8])), key=lambda place: well_exposedness(stops[8 * place]))
    middle = 2.0 ** max(stops[max(0, near - 8) : near + 9], key=well_exposedness)
    return tuple(float(middle * factor ** (k - (count - 1) / 2)) for k in range(count))


def _truth(scene: Scene, view: View) -> np.ndarray:
    if view.hdr is None:
        raise InputError(scene.name, f"view {view.name} has no HDR truth", "only scenes with truth can be exposed")
    return view.hdr


def noisy(exposure: np.ndarray, saturation: float, noise: SensorNoise, rng: np.random.Generator) -> np.ndarray:
    """Return the exposure that the sensor reports: photons counted up to the full well, then read with noise."""
    # Ten full wells saturate as surely as more, and Poisson's generator has a largest mean.
    photons = np.minimum(exposure / saturation, 10.0) * noise.full_well
    electrons = np.minimum(rng.poisson(photons), noise.full_well) + rng.normal(0.0, noise.read_noise, exposure.shape)
    return np.clip(electrons, 0.0, noise.full_well) * (saturation / noise.full_well)


def _recolor(scene: Scene, views: Sequence[View]) -> np.ndarray:
    """Return the colors [P, 3] float32 of the points in the new photos."""
    colors = scene.point_colors.astype(np.float32)
    nearest = np.full(len(colors), np.inf)
    for old, new in zip(scene.views, views, strict=True):
        if old.split != "train":
            continue
        row, column, _, visible = old.camera.project(scene.points)
        place = np.flatnonzero(visible)
        at = row[place].astype(int), column[place].astype(int)
        difference = np.abs(old.image[at] - scene.point_colors[place]).sum(axis=1)
        better = difference < nearest[place]
        nearest[place[better]] = difference[better]
        colors[place[better]] = new.image[at][better]
    return colors


def write_photo_set(
    scene: Scene, out: Path, response, times: Sequence[float], *, glare=0.0, noise=None, seed=0, overwrite=False
):
    """Write an HDR-NeRF synthetic set of a scene with truth.

    It holds photos at each time (seconds), poses, truth, and points in the colors of the middle time. Noise is sampled
    anew for each time. Raises as expose and write_tables.
    """
    exposed = [
        expose(scene, response, time, glare=glare, noise=noise, seed=seed * len(times) + k)
        for k, time in enumerate(times)
    ]
    views = [RadianceView(view.name, view.camera, _truth(scene, view), view.split) for view in scene.views]
    points = (scene.points, exposed[len(times) // 2].point_colors) if len(scene.points) else None
    photos = [[view.image for view in photographed.views] for photographed in exposed]
    with atomic_folder(out, overwrite) as folder:
        write_hdr_nerf_scene(folder, views, times, photos, points=points)


def write_hdr_nerf_scene(
    folder: Path,
    views: Sequence[RadianceView],
    exposure_times: Sequence[float],
    photos: Sequence[Sequence[np.ndarray]],
    points: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """Write a set that load_scene reads, with HDR-NeRF's file names.

    Args:
        folder: of the set, which exists.
        views: with their truth.
        exposure_times: seconds.
        photos: at each time one of each view, [H, W, 3] encoded in [0, 1], stored in 8 bits.
        points: [P, 3] positions and [P, 3] colors in [0, 1].

    Raises:
        InputError: for a camera that the layout cannot hold.
    """
    places = {"train": count(), "test": count()}

    def write_photo(photo: tuple[Path, np.ndarray]) -> None:
        Image.fromarray(codes_of(photo[1], 8)).save(photo[0])

    for index, view in enumerate(views):
        (folder / view.split).mkdir(parents=True, exist_ok=True)
        files = [(folder / view.split / f"{view.name}_{k}.png", photo[index]) for k, photo in enumerate(photos)]
        for _ in prefetch_map(write_photo, files, len(files)):
            pass
        write_radiance(truth_path(folder, view.split, next(places[view.split])), view.radiance)
    write_tables(folder, views, exposure_times, points)


def truth_path(folder: Path, split: str, place: int) -> Path:
    """Return the path of the EXR file of a split's frame number `place`."""
    return folder / f"{split}_hdr" / f"hdr_{place:03d}.exr"


def write_radiance(path: Path, radiance: np.ndarray, **options) -> None:
    """Write [H, W, 3] as OpenEXR; options are those of write_exr."""
    write_exr(path, dict(zip("RGB", np.moveaxis(radiance, 2, 0), strict=True)), overwrite=True, **options)


def write_tables(folder: Path, views: Sequence[RadianceView], times: Sequence[float], points, **metadata) -> None:
    """Write a set's poses, times and points, without its pictures; `metadata` are more fields of its JSON.

    Raises:
        InputError: for cameras that differ, or have no square pixels or centered principal point.
    """
    for split in ("train", "test"):
        split_views = [view for view in views if view.split == split]
        frames, exposures = [], {}
        for view in split_views:
            matrix = view.camera.camera_to_world.copy()
            matrix[:3, 1:3] *= -1  # To OpenGL's axes.
            frames.append({"file_path": f"./{split}/{view.name}", "transform_matrix": matrix.tolist()})
            exposures |= {f"./{split}/{view.name}_{k}.png": float(time) for k, time in enumerate(times)}
        if split_views:
            head = {"camera_angle_x": _view_angle(views), **metadata, "frames": frames}
            write_json(folder / f"transforms_{split}.json", head, overwrite=True)
            write_json(folder / f"exposure_{split}.json", exposures, overwrite=True)
    if points is not None:
        write_points(folder / "points3d.ply", *points)


def _view_angle(views: Sequence[RadianceView]) -> float:
    cameras = [view.camera for view in views]
    angles = {2 * math.atan(0.5 * camera.width / camera.fx) for camera in cameras}
    square = all(np.isclose(camera.fx, camera.fy, rtol=1e-9) for camera in cameras)
    middle = all(np.allclose(c.intrinsics[2:], [c.width / 2, c.height / 2], atol=1e-6) for c in cameras)
    if len(angles) > 1 or not (square and middle):
        problem = "has cameras that differ, or without square pixels and a centered principal point"
        raise InputError("the set", problem, "expose a set in HDR-NeRF's layout")
    return angles.pop()


def write_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write points [P, 3] and their colors [P, 3] in [0, 1] as PLY, as COLMAP and nerfstudio do."""
    from plyfile import PlyData, PlyElement

    kinds = [(axis, "f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    columns = np.hstack([points, np.clip(np.round(np.asarray(colors) * 255), 0, 255)])
    vertices = unstructured_to_structured(columns, np.dtype(kinds), casting="unsafe")
    with atomic_path(path, overwrite=True) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")]).write(str(temporary))
