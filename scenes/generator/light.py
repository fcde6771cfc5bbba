"""The light that reaches four places of a scene from all directions, beside its views: `light/place_<k>.exr`.

Each is an environment map as `sehdr-warp envmap --axes scene` writes it: R, G, B radiance in the set's unit, A which
part of a pixel shows surfaces (or sky) that two training views or more show, with the place in `sehdr:position`.
"""

import json
import logging
import tempfile
from pathlib import Path

import numpy as np

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.files import read_json
from sehdr_warp.output.images.exr import exr_header, rgb_channels, write_exr
from sehdr_warp.output.lighting.environment_map import envmap
from sehdr_warp.scene import Camera
from sehdr_warp.scene.images.hdr_files import read_hdr
from sehdr_warp.synth.expose import truth_path

from .recipes import Recipe, make_cameras, split_of
from .render import VARIANTS, _check_light, _sensor
from .stage import Stage

LOG = logging.getLogger("scenes.generator")
PLACES = ((0.0, 0.0, 0.0), (0.3, 0.0, 0.1), (0.2, 0.15, 0.05), (0.2, -0.15, 0.05))
"""From the middle of the training cameras: ahead towards what they look at, to the right and up, in distances to it."""
COLUMNS, SEEN_SAMPLES, FAR = 128, 16, 500.0
UNIT_SAMPLES, UNIT_ERROR = 32, 0.2


def render_light(mi, recipe: Recipe, folder: Path, samples: int) -> list[Path]:
    """Adds the maps to a set of truth of this recipe, rendered or packed; returns their paths.

    mi: from load_mitsuba, a variant that traces many rays at once. samples: light paths of a pixel in an easy scene.

    Raises InputError where the folder holds no set of this recipe.
    """
    if mi.variant().startswith("scalar"):
        raise SehdrError(f"maps of light need {' or '.join([*VARIANTS][:-1])}; this machine has {mi.variant()} alone")
    if (making := read_json(folder / "synth.json")).get("scene") != recipe.name:
        raise InputError(folder, f"is a set of {making.get('scene')!r}, not of {recipe.name}", "name its own folder")
    cameras = make_cameras(recipe.layout, making["width"], making["height"])
    train = [camera for view, camera in enumerate(cameras) if split_of(view) == "train"]
    with tempfile.TemporaryDirectory() as meshes:
        stage = Stage(mi, np.random.default_rng([making["seed"], *recipe.name.encode()]), Path(meshes))
        recipe.build(stage)
        scene = mi.load_dict(stage.items)
    tracer = mi.load_dict({"type": "path", "max_depth": recipe.depth, "rr_depth": 6})
    unit = _unit(mi, scene, tracer, train[0], folder)
    written = []
    for number, position in enumerate(_places(recipe, train)):
        radiance, coverage = _map(mi, scene, tracer, position, train, samples * recipe.effort)
        _check_light(radiance, f"{recipe.name}: the map of place {number} has", "take another number of --samples")
        facts = {"scene": recipe.name, "position": json.dumps(position.tolist()), "axes": "scene"}
        header = exr_header(provenance=facts | {"samples": str(samples * recipe.effort)}) | {
            "envmap": envmap("latlong")
        }
        header |= {"compression": _dwab(), "dwaCompressionLevel": 45.0}
        path = folder / "light" / f"place_{number}.exr"
        write_exr(path, rgb_channels(radiance * unit) | {"A": coverage}, header=header, overwrite=True)
        message = "%s: place %d at (%.2f, %.2f, %.2f), %.0f %% of its directions are seen, %.3g to %.4g"
        LOG.info(message, recipe.name, number, *position, 100 * coverage.mean(), radiance.min(), radiance.max())
        written.append(path)
    return written


def _dwab():
    import OpenEXR

    return OpenEXR.DWAB_COMPRESSION


def _places(recipe: Recipe, cameras: list[Camera]) -> list[np.ndarray]:
    middle = np.mean([camera.position for camera in cameras], axis=0)
    ahead = np.asarray(recipe.layout.target) - middle
    distance = float(np.linalg.norm(ahead))
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    axes = np.stack([ahead / distance, right / np.linalg.norm(right), [0.0, 0.0, 1.0]])
    return [middle + distance * np.asarray(place) @ axes for place in PLACES]


def _unit(mi, scene, tracer, camera: Camera, folder: Path) -> float:
    """What the set multiplied radiance by: packing takes a power of two."""
    stored = read_hdr(truth_path(folder, "train", 0))
    rendering = np.array(mi.render(scene, sensor=_sensor(mi, camera), integrator=tracer, spp=UNIT_SAMPLES, seed=1))[
        ..., :3
    ]
    ratio = float(np.median(stored.mean(2)) / np.median(rendering.mean(2)))
    unit = 2.0 ** round(np.log2(ratio))
    if not abs(ratio / unit - 1) < UNIT_ERROR:
        raise InputError(folder, f"is {ratio:.3g} times as bright as its recipe", "render it again by this generator")
    return unit


def _map(mi, scene, tracer, position: np.ndarray, cameras: list[Camera], samples: int) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 3] radiance and [H, W] what part of each pixel two cameras see."""
    width, height = COLUMNS, COLUMNS // 2
    total, coverage, traced = np.zeros((height * width, 3)), np.zeros(height * width), 0
    largest = max(1, VARIANTS[mi.variant()] // (height * width))
    while traced < samples:
        # The first launch is a small one, whose rays are also asked who sees what they meet.
        launch = min(largest, samples - traced) if traced else min(SEEN_SAMPLES, samples)
        sampler, ray = map_rays(mi, position, width, launch, traced)
        if not traced:
            coverage = np.array(_coverage(mi, scene, ray, cameras), np.float64).reshape(launch, -1).mean(0)
        light = np.array(tracer.sample(scene, sampler, ray)[0]).reshape(3, launch, -1)
        total += light.sum(1).T
        traced += launch
    return (total / samples).reshape(height, width, 3).astype(np.float32), coverage.reshape(height, width)


def map_rays(mi, position: np.ndarray, width: int, launch: int, seed: int):
    """Return a sampler and `launch` random rays through each pixel of a lat-long map of this width at a position."""
    import drjit as dr

    pixels = width * width // 2
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, pixels * launch)
    place = mi.UInt32(np.tile(np.arange(pixels, dtype=np.uint32), launch))
    sin, cos = dr.sincos(np.pi - 2 * np.pi * (mi.Float(place % width) + sampler.next_1d()) / width)
    up, flat = dr.sincos(np.pi / 2 - 2 * np.pi * (mi.Float(place // width) + sampler.next_1d()) / width)
    return sampler, mi.RayDifferential3f(mi.Point3f(*position.tolist()), mi.Vector3f(flat * sin, up, flat * cos))


def _coverage(mi, scene, ray, cameras: list[Camera]):
    """1 for each ray whose first surface, or sky, two cameras have in view from the same side, else 0."""
    import drjit as dr

    surface = scene.ray_intersect(ray)
    valid = surface.is_valid()
    point = dr.select(valid, surface.p, ray(FAR))
    facing = dr.dot(surface.n, -ray.d)
    count = mi.Float(0)
    for camera in cameras:
        x, y, z = (dr.dot(mi.Vector3f(*row[:3]), point) + row[3] for row in camera.world_to_camera[:3].tolist())
        column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        eye = mi.Point3f(*camera.position.tolist())
        away = point - eye
        distance = dr.norm(away)
        hidden = scene.ray_test(mi.Ray3f(mi.Ray3f(eye, away / distance), (1 - 1e-3) * distance))
        inside &= ~hidden & (~valid | (facing * dr.dot(surface.n, -away) > 0))  # Not from behind.
        count += dr.select(inside, 1.0, 0.0)
    return dr.select(count >= 2, 1.0, 0.0)
