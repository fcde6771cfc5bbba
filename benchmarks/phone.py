"""Compare trainings on photos with gain maps, as phones write them, with photos exposed two stops shorter.

python -m benchmarks.phone --json docs/reports/results/phone.json

Photos are files: JPEG at an exposure at which lights clip, each with a gain map of their light above white; and JPEG
and PNG two stops darker without one. White of all sets is the light of sRGB's code 1. `max_size` reduces photos on
reading, as trainings reduce photos of phones, whose maps are then as large as what is trained on.
"""

import io
import logging
import tempfile
from collections.abc import Callable
from functools import partial
from itertools import product
from math import atan
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image

from sehdr_warp.evaluation.evaluate import evaluate
from sehdr_warp.files import write_json
from sehdr_warp.output.images.ultra_hdr import MOST_STOPS, jpeg_with_gain_map, ultra_hdr
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene import load_scene
from sehdr_warp.synth.expose import exposure_ladder, write_radiance
from sehdr_warp.training.train import train

from .results import new_result
from .study import add_rows, run

LOG = logging.getLogger("phone")
SCENES = ("study", "window", "lamps", "night", "glass", "metal")
CURVE = response_by_name("srgb")
QUALITY = 95


def main(
    json: Path,
    scenes: tuple[str, ...] = SCENES,
    photos: tuple[str, ...] = ("three-channels", "one-channel", "libultrahdr", "darker-jpeg", "darker-png"),
    sizes: tuple[int, ...] = (100, 200),
    seeds: tuple[int, ...] = (0,),
    iterations: int = 4000,
    jobs: int = 1,
    device: str = "cuda",
) -> None:
    """Train every kind of photos of each scene.

    Args:
        json: file of the result.
        scenes: names of embedded scenes.
        photos: kinds of photos.
        sizes: longest sides of the photos, pixels.
        seeds: of the trainings.
        iterations: of a training.
        jobs: trainings at one time.
        device: cpu or cuda:N.
    """
    result = new_result("phone", torch.device(device), {"iterations": iterations})
    measure = partial(row, iterations=iterations, device=device)
    # Kernels are compiled once, not by each worker.
    row((seeds[0], sizes[0], scenes[0], photos[0]), iterations=30, device=device)
    add_rows(result, json, measure, product(seeds, sizes, scenes, photos), jobs)


def row(job: tuple[int, int, str, str], *, iterations: int, device: str) -> dict:
    """Train one kind of photos of a scene and return the held-out figures."""
    seed, size, name, photos = job
    response = "srgb" if KINDS[photos].stops else "auto"  # Files with gain maps state theirs.
    config = load_config("default", {"schedule.iterations": iterations, "seed": seed, "response.name": response})
    with tempfile.TemporaryDirectory() as folder:
        write_set(Path(folder) / "set", name, photos)
        scene = load_scene(Path(folder) / "set", max_size=size, response=response)
        figures = evaluate(train(scene, Path(folder) / "run", config, device=device), scene)
    clipped = figures["regions"]["clipped"]["psnr_mu"]["gt-max"]
    place = {"scene": name, "photos": photos, "size": size, "seed": seed}
    LOG.info("%s %.2f", place, figures["protocol"]["gt-max"]["psnr_mu"])
    return place | {"hdr": figures["protocol"]["gt-max"]["psnr_mu"], "clipped": clipped}


def write_set(folder: Path, name: str, photos: str) -> None:
    """Write a scene's photos, with the truth as OpenEXR beside them in multiples of white, and its cameras."""
    truth = load_scene(f"embedded:{name}", response="srgb")
    write, stops, suffix = KINDS[photos]
    time = exposure_ladder(truth, CURVE)[2] * 2.0**-stops
    for split, views in {"train": truth.train_views, "test": truth.test_views}.items():
        (folder / split).mkdir(parents=True)
        frames = []
        for view in views:
            assert view.hdr is not None
            light = view.hdr.astype(np.float32) * time
            write_radiance(folder / split / f"{view.name}.exr", light)
            (folder / split / f"{view.name}{suffix}").write_bytes(write(light))
            matrix = view.camera.camera_to_world * [1, -1, -1, 1]  # OpenGL's axes
            frames.append({"file_path": f"{split}/{view.name}.exr", "transform_matrix": matrix.tolist()})
        camera = views[0].camera
        angle = 2 * atan(camera.width / 2 / camera.fx)
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames})


def plain_jpeg(light: np.ndarray) -> bytes:
    """Return a JPEG of light [H, W, 3], without colors of half the size."""
    return _saved(_codes(light), "JPEG", quality=QUALITY, subsampling=0)


def plain_png(light: np.ndarray) -> bytes:
    """Return an 8-bit PNG of light [H, W, 3]."""
    return _saved(_codes(light), "PNG")


def three_channels(light: np.ndarray) -> bytes:
    """Return a JPEG with a gain map of three channels and the photo's size."""
    return ultra_hdr(light, np.asarray(CURVE.encode(light)))


def one_channel(light: np.ndarray) -> bytes:
    """Return a JPEG with a gain map of one channel and half of the photo's size, of its brightest channel."""
    base = np.asarray(CURVE.encode(light))
    light = np.minimum(light, 2**MOST_STOPS)
    gain = np.log2((light.max(2) + 1 / 64) / (np.minimum(light, 1).max(2) + 1 / 64))
    half = gain.reshape(gain.shape[0] // 2, 2, gain.shape[1] // 2, 2).mean((1, 3))
    return jpeg_with_gain_map(base, half, float(np.log2(light.max())))


def libultrahdr(light: np.ndarray) -> bytes:
    """Return what libultrahdr, the encoder of Android, makes of light: it chooses the photo's tones itself."""
    import imagecodecs  # Of the extra `spz`

    pixels = np.concatenate([light, np.ones_like(light[..., :1])], axis=2).astype(np.float16)
    return bytes(imagecodecs.ultrahdr_encode(pixels, level=QUALITY, gamut=imagecodecs.ULTRAHDR.CG.BT_709))


def _codes(light: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.asarray(CURVE.encode(light))).astype(np.uint8)


def _saved(codes: np.ndarray, kind: str, **options) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(codes).save(buffer, kind, **options)
    return buffer.getvalue()


class Kind(NamedTuple):
    """A kind of photos: who writes one, stops of shorter exposure, and the files' suffix."""

    write: Callable[[np.ndarray], bytes]
    stops: int
    suffix: str


KINDS = {
    "three-channels": Kind(three_channels, 0, ".jpg"),
    "one-channel": Kind(one_channel, 0, ".jpg"),
    "libultrahdr": Kind(libultrahdr, 0, ".jpg"),
    "darker-jpeg": Kind(plain_jpeg, 2, ".jpg"),
    "darker-png": Kind(plain_png, 2, ".png"),
}


if __name__ == "__main__":
    run(main)
