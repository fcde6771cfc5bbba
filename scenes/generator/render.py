"""Renders a scene's views by path tracing with Mitsuba 3, view by view, resumable, and writes the set of truth."""

import importlib.util
import json
import logging
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from sehdr_warp import __version__
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.files import atomic_path, write_json
from sehdr_warp.output.images.exr import exr_header
from sehdr_warp.scene import Camera
from sehdr_warp.scene.images.hdr_files import read_hdr
from sehdr_warp.synth.expose import RadianceView, truth_path, write_radiance

from .recipes import VIEWS, Recipe, make_cameras, split_of
from .stage import Stage, two_sided
from .truth_set import write_truth_tables

LOG = logging.getLogger("scenes.generator")
# From the fastest: an NVIDIA GPU with OptiX in its driver, LLVM 16 or later, plain C++ on all cores. With each, the
# samples of one launch over all pixels that fit memory: the wavefront variants hold every ray at once.
VARIANTS = {"cuda_ad_rgb": 2**24, "llvm_ad_rgb": 2**21, "scalar_rgb": 2**40}
DENOISERS = ("none", "oidn")
# Rays of a pixel for the denoiser's guides, to the first surface only.
_GUIDE_SAMPLES = 64
_OPENCV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's camera: +x left, +y up, +z forward.
_WHITE = {"type": "rgb", "value": [1.0, 1.0, 1.0]}

# An LLVM that is too old ends the whole process, and a driver without OptiX fails at the first ray: hence a process of
# its own, and a render in it.
_PROBE = """
import sys, mitsuba as mi
mi.set_variant(sys.argv[1])
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "light": {"type": "constant"},
    "ball": {"type": "sphere"},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}})
import numpy as np
assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
"""


def load_mitsuba(variant: str = "auto"):
    """The mitsuba module with a variant set: one of VARIANTS, or "auto" for the first that works here.

    Raises SehdrError where Mitsuba is missing, or the variant does not run on this machine.
    """
    if importlib.util.find_spec("mitsuba") is None:
        raise SehdrError("Mitsuba 3 renders the scenes and is not installed; pip install mitsuba")
    if variant == "auto":
        variant = next((name for name in [*VARIANTS][:-1] if _probe(name) is None), "scalar_rgb")
    elif (reason := _probe(variant)) is not None:
        raise SehdrError(f"--variant {variant}: does not run here ({reason}); take auto or scalar_rgb")
    import mitsuba

    mitsuba.set_variant(variant)
    return mitsuba


def _probe(variant: str, seconds: float = 120.0) -> str | None:
    """None where a variant renders on this machine, else why it does not, in a line."""
    command = [sys.executable, "-c", _PROBE, variant]
    try:
        process = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return f"no picture within {seconds:.0f} s"
    if process.returncode == 0:
        return None
    lines = [line.strip() for line in process.stderr.splitlines() if line.strip()]
    telling = [line for line in lines if "rror" in line or "LLVM" in line or "could not" in line.lower()]
    return f"{(telling or lines or ['no message'])[-1]:.160}"


@dataclass(frozen=True)
class Settings:
    """What the pixels of a set depend on.

    width, height: pixels; samples: light paths of a pixel, to be multiplied by the recipe's effort; seed: of geometry,
    textures and paths; views: numbers in [0, 35) or None for all; denoise: one of DENOISERS.
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
        if self.denoise not in DENOISERS:
            raise SehdrError(f"--denoise {self.denoise:.40}: is not one of {', '.join(DENOISERS)}")
        if self.denoise == "oidn" and importlib.util.find_spec("pyoidn") is None:
            raise SehdrError("Open Image Denoise is not installed; pip install pyoidn, or take --denoise none")


def render_scene(mi, recipe: Recipe, out: Path, settings: Settings) -> Path:
    """Render `out`/<name>: finished views are kept, so a run that was stopped goes on. Returns the folder.

    mi: from load_mitsuba. Each view is the mean of its paths a pixel under a box filter, without clamping: unbiased
    but for paths longer than the recipe's depth. The halves of the samples, compared, give the noise of that mean (in
    synth.json). Settings.denoise "oidn" then trades most of it for a bias of the denoiser's.

    A seed gives the same things and lights again. The paths, and with them the noise, may differ: Mitsuba does not
    number its lights in the same order each time.

    Raises InputError where the folder holds a set of other settings, SehdrError where a pixel is not finite.
    """
    folder = out / recipe.name
    _claim(folder, recipe, settings)
    cameras = make_cameras(recipe.layout, settings.width, settings.height)
    chosen = sorted(settings.views or range(VIEWS))
    places = {}
    for split in ("train", "test"):
        views = [view for view in chosen if split_of(view) == split]
        places |= {view: truth_path(folder, split, place) for place, view in enumerate(views)}
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
            line = render_view(mi, scene, recipe, cameras[view], view, settings, denoiser, *where)
            LOG.info("%s: view %d of %d, %s", recipe.name, view, VIEWS, line)
    _finish(mi, recipe, folder, settings, {view: cameras[view] for view in chosen}, places)
    return folder


def _claim(folder: Path, recipe: Recipe, settings: Settings) -> None:
    """Note the settings in a new folder; refuse one with others."""
    path = folder / "work" / "settings.json"
    request = json.loads(json.dumps(asdict(settings) | {"scene": recipe.name}))
    if path.is_file():
        try:
            record = json.loads(path.read_text())
        except (OSError, ValueError):
            record = None
        if record != request:
            raise InputError(folder, f"was begun with other settings ({record})", "give the same, or another --out")
    else:
        if folder.is_dir() and any(folder.iterdir()):
            raise InputError(folder, "exists already and is no unfinished rendering", "choose another --out")
        write_json(path, request)


def _aside(folder: Path, view: int) -> Path:
    """Figures of a view, kept for synth.json."""
    return folder / "work" / f"r_{view}.npz"


def _sensor(mi, camera: Camera):
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "rgb", "component_format": "float32"}
    place = mi.ScalarTransform4f(camera.camera_to_world @ _OPENCV_TO_MITSUBA)
    angle = float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx)))
    sensor = {"type": "perspective", "to_world": place, "fov": angle, "fov_axis": "x", "film": film}
    return mi.load_dict(sensor | {"near_clip": 0.01, "far_clip": 1000.0, "sampler": {"type": "independent"}})


def _check_light(radiance: np.ndarray, subject: str, remedy: str) -> None:
    """SehdrError where a pixel [H, W, 3] cannot be light: truth that is not finite would poison whatever it judges."""
    if not np.isfinite(radiance).all() or radiance.min() < 0:
        raise SehdrError(f"{subject} pixels that are not finite or negative; {remedy}")


def render_view(mi, scene, recipe, camera, view: int, settings, denoiser, path: Path, aside: Path) -> str:
    """Render a view and write it, with what guides denoising; return a line about it."""
    started = time.perf_counter()
    sensor = _sensor(mi, camera)
    tracer = mi.load_dict({"type": "path", "max_depth": recipe.depth, "rr_depth": 6})
    halves, counts = np.zeros((2, camera.height, camera.width, 3)), [0, 0]
    samples = settings.samples * recipe.effort
    largest = max(1, VARIANTS[mi.variant()] // (camera.width * camera.height))
    launches = 2 * -(-samples // (2 * largest))
    for turn in range(launches):
        share = samples * (turn + 1) // launches - samples * turn // launches
        seed = ((settings.seed * VIEWS + view) * 4096 + turn) % 2**32
        image = mi.render(scene, sensor=sensor, integrator=tracer, spp=share, seed=seed)
        halves[turn % 2] += np.array(image, np.float64)[..., :3] * share
        counts[turn % 2] += share
    radiance = (halves.sum(0) / samples).astype(np.float32)
    _check_light(radiance, f"{recipe.name}: view {view} has", "take another --seed")
    noise = _noise(halves[0] / counts[0], halves[1] / counts[1])
    if denoiser is not None:
        radiance = denoiser(radiance, sensor, (settings.seed * VIEWS + view) % 2**32)
        _check_light(radiance, f"{recipe.name}: view {view}, denoised, has", "take --denoise none, with more --samples")
    seconds = time.perf_counter() - started
    with atomic_path(aside, overwrite=True) as temporary:
        np.savez_compressed(temporary, seconds=seconds, noise=noise)
    header = exr_header(camera=camera, provenance={"scene": recipe.name, "samples": str(samples)})
    write_radiance(path, radiance, pixel="float", header=header)
    return f"{seconds:.1f} s, {radiance.min():.3g} to {radiance.max():.4g}, noise {-20 * np.log10(noise + 1e-9):.1f} dB"


def _noise(first: np.ndarray, second: np.ndarray) -> float:
    """Standard error of the mean of two halves, RMS over the picture in mu-law values (mu 5000) of E / max E."""
    scale = max(first.max(), second.max(), 1e-30)
    first, second = (np.log1p(5000 * half / scale) / np.log1p(5000) for half in (first, second))
    return float(np.sqrt(np.mean((first - second) ** 2)) / 2)


def _finish(mi, recipe: Recipe, folder: Path, settings: Settings, cameras: dict[int, Camera], places: dict[int, Path]):
    views, figures = [], []
    for view, camera in cameras.items():
        views.append(RadianceView(f"r_{view}", camera, read_hdr(places[view]), split_of(view)))
        with np.load(_aside(folder, view)) as figure:
            figures.append(dict(figure))
    luminance = np.concatenate([(view.radiance @ [0.2126, 0.7152, 0.0722]).ravel() for view in views])
    low, high = np.maximum(np.percentile(luminance, [1, 99.9]), 1e-30)
    making = asdict(settings) | {
        "scene": recipe.name,
        "title": recipe.title,
        "paths_of_a_pixel": settings.samples * recipe.effort,
        "generator": f"sehdr-warp {__version__}, Mitsuba {mi.__version__}, {mi.variant()}",
        "seconds": float(sum(figure["seconds"] for figure in figures)),
        "noise_db": -10 * float(np.log10(np.mean([figure["noise"] ** 2 for figure in figures]) + 1e-18)),
        # Of luminance, between the 1st and the 99.9th percentile.
        "decades": float(np.log10(high / low)),
    }
    if settings.denoise == "oidn":
        making["denoiser"] = f"Open Image Denoise (pyoidn {version('pyoidn')})"
    write_truth_tables(folder, views, making)


class Denoiser:
    """Denoises the views of one scene by Open Image Denoise.

    The guides are each pixel's albedo and shading normal: they hold edges and textures, and have no light in them, so
    hardly any noise. Where more than half of a pixel's radiance comes straight from a light or the sky it is kept as
    rendered: such light has no path noise, and at 10^5 times its surroundings a filter would spill it.

    mi: the imported mitsuba module with its variant set. items, scene: what Stage collected, and loaded.
    """

    def __init__(self, mi, items: dict, scene):
        self.mi, self.scene = mi, scene
        self.guides_of = mi.load_dict(guide_items(items))
        self.guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,facing:sh_normal"})
        self.straight = mi.load_dict({"type": "path", "max_depth": 1})

    def __call__(self, radiance: np.ndarray, sensor, seed: int) -> np.ndarray:
        """[H, W, 3] >= 0, of the same sensor -> the same, denoised, >= 0."""
        options = {"sensor": sensor, "spp": _GUIDE_SAMPLES, "seed": seed}
        guides = np.array(self.mi.render(self.guides_of, integrator=self.guides, **options), np.float32)[..., -6:]
        straight = np.array(self.mi.render(self.scene, integrator=self.straight, **options), np.float32)[..., :3]
        return denoise(radiance, guides[..., :3], guides[..., 3:], straight)


def denoise(radiance: np.ndarray, albedo: np.ndarray, normal: np.ndarray, straight: np.ndarray) -> np.ndarray:
    """radiance, straight (of it, what lights and the sky send to the camera themselves): [H, W, 3] >= 0; albedo in
    [0, 1]; normal in [-1, 1]."""
    import pyoidn  # pyright: ignore[reportMissingImports]

    images = radiance, np.clip(albedo, 0, 1), np.clip(normal, -1, 1)
    clean = pyoidn.denoise(*(np.ascontiguousarray(image, np.float32) for image in images), hdr=True, clean_aux=True)
    lit = straight.sum(-1) > 0.5 * radiance.sum(-1)
    return np.where(lit[..., None], radiance, np.maximum(clean, 0)).astype(np.float32)


def guide_items(items: dict) -> dict:
    """A scene for albedo and normals: every surface diffuse, of its own or a varnish's albedo, or white; the sky a
    white ball beyond all things and within the cameras' far plane."""
    white, guides = two_sided(type="diffuse", reflectance=_WHITE), {}
    for name, item in items.items():
        if not isinstance(item, dict):
            guides[name] = item
        elif item["type"] == "envmap":
            guides[name] = {"type": "sphere", "radius": 500.0, "flip_normals": True, "bsdf": white}
        elif "bsdf" in item:
            layer = {} if "emitter" in item else item["bsdf"].get("layer", {})
            paint = layer.get("reflectance") or layer.get("diffuse_reflectance") or _WHITE
            plain = {key: value for key, value in item.items() if key != "emitter"}
            guides[name] = plain | {"bsdf": two_sided(type="diffuse", reflectance=paint)}
    return guides
