"""An environment map beside the truth: a room rendered by Mitsuba, trained on the truth of cameras all around.

python -m benchmarks.panorama --work panorama_work --json docs/reports/results/panorama.json

Cameras stand within some steps of a place and look in all directions. The map of that place, and perspective views from
there, are compared with what Mitsuba renders of them: mu-law PSNR with one peak, the brightest of the truth.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenes.generator.light import map_rays
from scenes.generator.recipes import RECIPES
from scenes.generator.render import _sensor, load_mitsuba
from scenes.generator.stage import Stage
from sehdr_warp.evaluation.metrics import mu_law
from sehdr_warp.model.baking import sphere_directions
from sehdr_warp.output.lighting.environment_map import latlong, solid_angles, write_environment_map
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run import load_run
from sehdr_warp.scene import Camera, Scene, View, codes_of, look_at
from sehdr_warp.scene.images.hdr_files import read_hdr
from sehdr_warp.synth.expose import ladder_of
from sehdr_warp.training.train import train

from .results import finish, new_result
from .study import run

LOG = logging.getLogger("panorama")
RECIPE = "study"
PLACE, SPREAD = np.array([0.0, -0.8, 1.3]), np.array([0.6, 0.5, 0.35])
"""Meters, in the room: where the map is seen from, and how far from there cameras stand."""
DEPTH, BATCH = 4, 1 << 21
POLE, EDGE = np.radians(15), 8
"""Radians around a pole, and columns at either end of the map, where errors of a projection would show."""


def main(
    json: Path,
    work: Path,
    views: int = 72,
    size: int = 128,
    width: int = 512,
    samples: int = 64,
    iterations: int = 3000,
    device: str = "cpu",
) -> None:
    """Render, train and compare; a training in `work` is not repeated.

    Args:
        json: file of the result.
        work: folder for views, run and map.
        views: training views.
        size: width and height of a view, pixels.
        width: of the map, pixels.
        samples: light paths of a training view's pixel; the compared pictures take four times as many.
        iterations: of the training.
        device: cpu or cuda:N.
    """
    work.mkdir(parents=True, exist_ok=True)
    places = PLACE + SPREAD * np.random.default_rng(0).uniform(-1, 1, (views, 3))
    cameras = [_camera(size, place, out) for place, out in zip(places, sphere_directions(views), strict=True)]
    judged = [_camera(size, PLACE, out) for out in sphere_directions(12)]
    truth = work / "truth.npz"
    if not truth.is_file():
        _render(truth, cameras, judged, width, samples)
    with np.load(truth) as arrays:
        photos, truth_views, panorama = arrays["seen"], arrays["judged"], arrays["panorama"]
    scene = _scene(cameras, photos)
    settings = {"views": views, "size": size, "width": width, "samples": samples, "iterations": iterations}
    result = new_result("panorama", torch.device(device), settings)
    config = load_config("truth", {"schedule.iterations": iterations})
    is_trained = (work / "run" / "summary.json").is_file()
    run = load_run(work / "run", device=device) if is_trained else train(scene, work / "run", config, device=device)
    at = (float(PLACE[0]), float(PLACE[1]), float(PLACE[2]))
    map_file = write_environment_map(
        run, work / "map.exr", at=at, size=width, axes="scene", pixel="float", overwrite=True
    )
    peak = float(max(truth_views.max(), panorama.max()))
    renders = np.stack([run.render(camera).hdr.cpu().numpy() for camera in judged])
    rays = np.stack([_rays(camera) for camera in judged])
    weight, directions = solid_angles(width, "latlong"), latlong(width)
    errors = _squared_distance(_even(read_hdr(map_file)), _even(panorama), peak)
    column = np.arange(width)
    edge = np.broadcast_to((column < EDGE) | (column >= width - EDGE), errors.shape)
    pole, shown_pole = (np.abs(each[..., 1]) > np.cos(POLE) for each in (directions, rays))
    plain = _squared_distance(renders, truth_views, peak)
    parts = {
        "12 perspective views": (plain, np.ones(plain.shape)),
        "of these, 15 degrees around the map's poles": (plain, 1.0 * shown_pole),
        "the map": (errors, weight),
        f"the map, {EDGE} columns on each side of the wrap": (errors, weight * edge),
        "the map, 15 degrees around each pole": (errors, weight * pole),
        "the map elsewhere": (errors, weight * ~(edge | pole)),
    }
    for name, (squared, share) in parts.items():
        psnr = -10 * np.log10((squared * share).sum() / share.sum())
        result["rows"].append({"what": name, "psnr": float(psnr)})
    rendered_light, true_light = (_irradiance(image, directions, weight) for image in (read_hdr(map_file), panorama))
    off = np.abs(rendered_light / true_light - 1)
    error_text = f"{off.mean():.1%} off in the mean, {off.max():.1%} at most"
    result["notes"].append(f"Irradiance of surfaces that face {len(off)} directions: {error_text}.")
    result["notes"].append(f"{run.gaussian_count:,} Gaussians; the truth's peak is {peak:.3g}.")
    finish(result, json, overwrite=True)


def _camera(size: int, position: np.ndarray, out: np.ndarray) -> Camera:
    """80 degrees wide."""
    focal = 0.5 * size / np.tan(np.radians(40))
    return Camera(size, size, focal, focal, size / 2, size / 2, look_at(position, position + out))


def _rays(camera: Camera) -> np.ndarray:
    """[H, W, 3] unit directions of a camera's pixels in the world."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5 - camera.cx, np.arange(camera.height) + 0.5 - camera.cy)
    local = np.stack([x / camera.fx, y / camera.fy, np.ones_like(x)], axis=2)
    return local / np.linalg.norm(local, axis=2, keepdims=True) @ camera.world_to_camera[:3, :3]


def _scene(cameras: list[Camera], photos: np.ndarray) -> Scene:
    curve = response_by_name("srgb")
    time = ladder_of(RECIPE, list(photos), curve.encode)[2]
    views = [
        View(f"r_{i}", codes_of(np.asarray(curve.encode(hdr * time)), 8), camera, time, "train", hdr=hdr)
        for i, (camera, hdr) in enumerate(zip(cameras, photos, strict=True))
    ]
    return Scene(RECIPE, "transforms", tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.float32), response=curve)


def _render(path: Path, cameras: list[Camera], judged: list[Camera], width: int, samples: int) -> None:
    mi: Any = load_mitsuba()
    recipe, meshes = RECIPES[RECIPE], path.with_name("meshes")
    meshes.mkdir(exist_ok=True)
    stage = Stage(mi, np.random.default_rng([0, *recipe.name.encode()]), meshes)
    recipe.build(stage)
    scene = mi.load_dict(stage.items)
    tracer = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": DEPTH})

    def view(index: int, camera: Camera, count: int) -> np.ndarray:
        LOG.info("view %d", index)
        return np.array(mi.render(scene, sensor=_sensor(mi, camera), integrator=tracer, spp=count, seed=index))[..., :3]

    photos = np.stack([view(i, camera, samples) for i, camera in enumerate(cameras)])
    truth_views = np.stack([view(1000 + i, camera, 4 * samples) for i, camera in enumerate(judged)])
    np.savez_compressed(
        path, seen=photos, judged=truth_views, panorama=_panorama(mi, scene, tracer, width, 4 * samples)
    )


def _panorama(mi: Any, scene: Any, tracer: Any, width: int, samples: int) -> np.ndarray:
    """[H, W, 3] by rays of its own: Mitsuba has no camera for it."""
    pixels = width * width // 2
    launch = min(samples, max(1, BATCH // pixels))
    turns, total = -(-samples // launch), np.zeros((pixels, 3))
    for turn in range(turns):
        LOG.info("panorama, launch %d", turn)
        sampler, ray = map_rays(mi, PLACE, width, launch, turn)
        total += np.array(tracer.sample(scene, sampler, ray)[0]).reshape(3, launch, -1).sum(1).T / (launch * turns)
    return total.reshape(width // 2, width, 3).astype(np.float32)


def _irradiance(image: np.ndarray, directions: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """[200] up to scale, mean over channels."""
    light = image.mean(axis=2) * weight
    return np.array([(light * np.maximum(directions @ normal, 0)).sum() for normal in sphere_directions(200)])


def _even(image: np.ndarray) -> np.ndarray:
    """Average the rows of a lat-long map over as many pixels as cover one pixel of the equator.

    Towards the poles a map has more pixels than the photos resolve, and the truth has their detail.
    """
    height, width = image.shape[:2]
    result = np.empty_like(image)
    for row, latitude in enumerate(np.pi * ((np.arange(height) + 0.5) / height - 0.5)):
        starts = np.arange(0, width, min(width, round(1 / np.cos(latitude))))
        counts = np.diff(starts, append=width)[:, None]
        result[row] = np.repeat(np.add.reduceat(image[row], starts) / counts, counts[:, 0], axis=0)
    return result


def _squared_distance(image: np.ndarray, truth: np.ndarray, peak: float) -> np.ndarray:
    """[...] squared mu-law error, mean over channels."""
    values = (mu_law(torch.from_numpy(np.ascontiguousarray(each)) / peak) for each in (image, truth))
    return (next(values) - next(values)).square().mean(-1).numpy()


if __name__ == "__main__":
    run(main)
