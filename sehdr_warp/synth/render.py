"""Renders a scene's views by path tracing, view by view, resumable, and writes the set of truth."""

import json
import logging
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from .. import __version__
from ..errors import InputError, SehdrError
from ..files import atomic_path, write_json
from ..output.exr import exr_header, read_exr, write_exr
from ..scene import Camera
from .cameras import VIEWS, make_cameras, split_of
from .denoise import Denoiser, check_denoiser, denoiser_version
from .photo_set import RadianceView
from .scenes import Recipe
from .stage import Stage
from .truth_set import truth_path, write_truth_tables

LOG = logging.getLogger(__name__)
# Samples of one launch, over all pixels: what fits memory (the wavefront variants hold every ray at once).
_RAYS = {"cuda_ad_rgb": 2**24, "llvm_ad_rgb": 2**21, "scalar_rgb": 2**40}
# Surface points kept of each training view.
_POINTS_OF_A_VIEW = 1200
_OPENCV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's camera: +x left, +y up, +z forward.


@dataclass(frozen=True)
class Settings:
    """What the pixels of a set depend on.

    width, height: pixels; samples: light paths of a pixel, to be multiplied by the recipe's effort; seed: of geometry,
    textures and paths; views: numbers in [0, 35) or None for all; denoise: one of denoise.DENOISERS.
    """

    width: int = 200
    height: int = 200
    samples: int = 512
    seed: int = 0
    views: tuple[int, ...] | None = None
    denoise: str = "none"

    def __post_init__(self):
        if not (1 <= self.width <= 8192 and 1 <= self.height <= 8192):
            raise SehdrError(f"--size {self.width}x{self.height}: give 1 to 8192 pixels a side")
        if not 2 <= self.samples <= 2**24:
            raise SehdrError(f"--samples {self.samples}: give 2 or more")
        if not 0 <= self.seed < 2**31:
            raise SehdrError(f"--seed {self.seed}: give 0 to 2^31 - 1")
        wrong = [view for view in self.views or () if not 0 <= view < VIEWS]
        if wrong or self.views == ():
            raise SehdrError(f"--views {wrong}: views are numbered from 0 to {VIEWS - 1}")
        check_denoiser(self.denoise)


def render_scene(mi, recipe: Recipe, out: Path | str, settings: Settings) -> Path:
    """Render `out`/<name>: finished views are kept, so a run that was stopped goes on. Returns the folder.

    mi: from load_mitsuba. Each view is the mean of its paths a pixel under a box filter, without clamping: unbiased
    but for paths longer than the recipe's depth, which all views lack alike. The halves of the samples, compared, give
    the noise of that mean (in synth.json). Settings.denoise "oidn" then trades most of it for a bias of the denoiser's.

    A seed gives the same things and lights again. The paths, and with them the noise, may differ: Mitsuba does not
    number its lights in the same order each time.

    Raises InputError where the folder holds a set of other settings, SehdrError where a pixel is not finite.
    """
    folder = Path(out) / recipe.name
    chosen = sorted(settings.views or range(VIEWS))
    _claim(folder, recipe, settings)
    cameras = make_cameras(recipe.layout, settings.width, settings.height)
    places, counts = {}, {"train": 0, "test": 0}
    for view in chosen:
        places[view] = truth_path(folder, split_of(view), counts[split_of(view)])
        counts[split_of(view)] += 1
    missing = [view for view in chosen if not (places[view].is_file() and _aside(folder, view).is_file())]
    if len(missing) < len(chosen):
        LOG.info("%s: %d of %d views are there already", recipe.name, len(chosen) - len(missing), len(chosen))
    if missing:
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as meshes:
            stage = Stage(mi, np.random.default_rng([settings.seed, *recipe.name.encode()]), Path(meshes))
            recipe.build(stage)
            scene = mi.load_dict(stage.items)
            denoiser = Denoiser(mi, stage.items, scene) if settings.denoise == "oidn" else None
        LOG.info("%s: %d things built in %.1f s", recipe.name, len(stage.items), time.perf_counter() - started)
        for view in missing:
            where = places[view], _aside(folder, view)
            line = _render_view(mi, scene, recipe, cameras[view], view, settings, denoiser, *where)
            LOG.info("%s: view %d of %d, %s", recipe.name, view, VIEWS, line)
    _finish(mi, recipe, folder, settings, {view: cameras[view] for view in chosen}, places)
    return folder


def _claim(folder: Path, recipe: Recipe, settings: Settings) -> None:
    """Note the settings in a new folder; refuse one with others."""
    path = folder / "work" / "settings.json"
    wanted = json.loads(json.dumps(asdict(settings) | {"scene": recipe.name}))
    if path.is_file():
        try:
            found = json.loads(path.read_text())
        except (OSError, ValueError):
            found = None
        if found != wanted:
            raise InputError(folder, f"was begun with other settings ({found})", "give the same, or another --out")
    else:
        if folder.is_dir() and any(folder.iterdir()):
            raise InputError(folder, "exists already and is no unfinished rendering", "choose another --out")
        write_json(path, wanted)


def _aside(folder: Path, view: int) -> Path:
    """Surface points and figures of a view, kept for the set's tables."""
    return folder / "work" / f"r_{view}.npz"


def _sensor(mi, camera: Camera):
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "rgb", "component_format": "float32"}
    place = mi.ScalarTransform4f(camera.camera_to_world @ _OPENCV_TO_MITSUBA)
    angle = float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx)))
    sensor = {"type": "perspective", "to_world": place, "fov": angle, "fov_axis": "x", "film": film}
    return mi.load_dict(sensor | {"near_clip": 0.01, "far_clip": 1000.0, "sampler": {"type": "independent"}})


def _check_light(radiance: np.ndarray, found: str, remedy: str) -> None:
    """SehdrError where a pixel [H, W, 3] cannot be light: truth that is not finite would poison whatever it judges."""
    if not np.isfinite(radiance).all() or radiance.min() < 0:
        raise SehdrError(f"{found} pixels that are not finite or negative; {remedy}")


def _render_view(mi, scene, recipe: Recipe, camera: Camera, view: int, settings: Settings, denoiser: Denoiser | None,
                 path: Path, aside: Path) -> str:  # fmt: skip
    started = time.perf_counter()
    sensor = _sensor(mi, camera)
    tracer = mi.load_dict({"type": "path", "max_depth": recipe.depth, "rr_depth": 6})
    halves = [np.zeros((camera.height, camera.width, 3)) for _ in range(2)]
    samples = settings.samples * recipe.effort
    largest = max(1, _RAYS[mi.variant()] // (camera.width * camera.height))
    launches = 2 * -(-samples // (2 * largest))
    counts = [0, 0]
    for turn in range(launches):
        share = samples * (turn + 1) // launches - samples * turn // launches
        seed = ((settings.seed * VIEWS + view) * 4096 + turn) % 2**32
        image = mi.render(scene, sensor=sensor, integrator=tracer, spp=share, seed=seed)
        halves[turn % 2] += np.array(image, np.float64)[..., :3] * share
        counts[turn % 2] += share
    radiance = (sum(halves) / samples).astype(np.float32)
    _check_light(radiance, f"{recipe.name}: view {view} has", "take another --seed")
    noise = _noise(*(half / count for half, count in zip(halves, counts, strict=True)))
    if denoiser is not None:
        radiance = denoiser(radiance, sensor, (settings.seed * VIEWS + view) % 2**32)
        _check_light(radiance, f"{recipe.name}: view {view}, denoised, has", "take --denoise none, with more --samples")
    seconds = time.perf_counter() - started
    found = {"seconds": seconds, "noise": noise, "largest": radiance.max()}
    if split_of(view) == "train":
        found |= _surface_points(mi, scene, sensor, radiance, view)
    with atomic_path(aside, overwrite=True) as temporary:
        np.savez_compressed(temporary, **found)
    header = exr_header(camera=camera, provenance={"scene": recipe.name, "samples": str(samples)})
    channels = dict(zip("RGB", np.moveaxis(radiance, 2, 0), strict=True))
    write_exr(path, channels, pixel="float", header=header, overwrite=True)
    return f"{seconds:.1f} s, {radiance.min():.3g} to {radiance.max():.4g}, noise {-20 * np.log10(noise + 1e-9):.1f} dB"


def _noise(first: np.ndarray, second: np.ndarray) -> float:
    """Standard error of the mean of two halves, RMS over the picture in mu-law values (mu 5000) of E / max E."""
    scale = max(first.max(), second.max(), 1e-30)
    first, second = (np.log1p(5000 * half / scale) / np.log1p(5000) for half in (first, second))
    return float(np.sqrt(np.mean((first - second) ** 2)) / 2)


def _surface_points(mi, scene, sensor, radiance: np.ndarray, view: int) -> dict[str, np.ndarray]:
    """Places that the view's pixels show (one ray each, none of the sky) and their radiance."""
    probe = mi.load_dict({"type": "aov", "aovs": "place:position,away:depth"})
    shown = np.array(mi.render(scene, sensor=sensor, integrator=probe, spp=1, seed=view), np.float32)[..., -4:]
    row, column = np.nonzero(shown[..., 3] > 0)
    keep = np.random.default_rng(view).permutation(len(row))[:_POINTS_OF_A_VIEW]
    row, column = row[keep], column[keep]
    return {"points": shown[row, column, :3], "radiance": radiance[row, column]}


def _finish(mi, recipe: Recipe, folder: Path, settings: Settings, cameras: dict[int, Camera], places: dict[int, Path]):
    views, points, colours, seconds, noise = [], [], [], [], []
    for view, camera in cameras.items():
        pixels, _, _ = read_exr(places[view])
        views.append(RadianceView(f"r_{view}", camera, pixels[..., :3], split_of(view)))
        with np.load(_aside(folder, view)) as found:
            seconds.append(float(found["seconds"]))
            noise.append(float(found["noise"]))
            if "points" in found:
                points.append(found["points"])
                colours.append(found["radiance"])
    making = asdict(settings) | {
        "scene": recipe.name,
        "title": recipe.title,
        "paths_of_a_pixel": settings.samples * recipe.effort,
        "generator": f"sehdr-warp {__version__}, Mitsuba {mi.__version__}, {mi.variant()}",
        "seconds": sum(seconds),
        "noise_db": -20 * float(np.log10(np.sqrt(np.mean(np.square(noise))) + 1e-9)),
        "decades": dynamic_range([view.radiance for view in views]),
    }
    empty = [np.zeros((0, 3), np.float32)]
    if settings.denoise == "oidn":
        making["denoiser"] = denoiser_version()
    write_truth_tables(folder, views, np.concatenate(points or empty), np.concatenate(colours or empty), making)


def dynamic_range(images: Sequence[np.ndarray]) -> float:
    """Decades of luminance (Rec.709) between the 1st and the 99.9th percentile over all pixels."""
    luminance = np.concatenate([(image @ np.array([0.2126, 0.7152, 0.0722])).ravel() for image in images])
    low, high = np.percentile(luminance, [1, 99.9])
    return float(np.log10(max(high, 1e-30) / max(low, 1e-30)))
