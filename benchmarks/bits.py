"""Measure the gain of a photo's bits: scenes with truth, photographed linearly and through a curve at 8 to 14 bits.

python -m benchmarks.bits --json docs/reports/results/bits.json

White is the same for all: the light that sRGB's code 1 shows. Linear photos are what a sensor writes to a RAW file,
curved ones what a JPEG (8 bits) or a TIFF holds. `camera` adds the noise of a sensor of 20,000 electrons that reads out
with 5.
"""

import logging
import tempfile
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import torch

from sehdr_warp.evaluation.evaluate import evaluate
from sehdr_warp.response import Response, response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene import Scene, codes_of, load_scene
from sehdr_warp.scene.raw.decode import linear_codes
from sehdr_warp.synth.expose import SensorNoise, exposure_ladder, noisy
from sehdr_warp.training.train import train

from .results import new_result
from .study import add_rows, run

LOG = logging.getLogger("bits")
SCENES = ("window", "lamps", "sunlit", "night")
PHOTOS = [(bits, kind, "none") for kind in ("curve", "linear") for bits in (8, 10, 12, 14)]
PHOTOS += [(8, "curve", "camera"), (14, "linear", "camera")]


def main(
    json: Path,
    scenes: tuple[str, ...] = SCENES,
    exposures: tuple[int, ...] = (0, 2),
    iterations: int = 2000,
    max_size: int | None = None,
    jobs: int = 1,
    device: str = "cuda",
) -> None:
    """Train every kind of photo of each scene.

    Args:
        json: file of the result.
        scenes: names of embedded scenes.
        exposures: out of a ladder of five, 0 to 4.
        iterations: of a training.
        max_size: longest side of the photos, pixels.
        jobs: trainings at one time.
        device: cpu or cuda:N.
    """
    result = new_result("bits", torch.device(device), {"iterations": iterations, "max_size": max_size})
    measure_row = partial(row, iterations=iterations, max_size=max_size, device=device)
    # Kernels are compiled once, not by each worker.
    row((scenes[0], exposures[0], *PHOTOS[0]), iterations=30, max_size=max_size, device=device)
    combinations = [(scene, exposure, *photos) for exposure, scene, photos in product(exposures, scenes, PHOTOS)]
    add_rows(result, json, measure_row, combinations, jobs)


def row(job: tuple[str, int, int, str, str], *, iterations: int, max_size: int | None, device: str) -> dict:
    """Train one kind of photos of a scene and return the held-out figures."""
    name, exposure, bits, kind, noise = job
    curve = response_by_name("srgb")
    truth = load_scene(f"embedded:{name}", max_size=max_size, response="srgb")
    time = exposure_ladder(truth, curve)[exposure]
    scene = photograph(truth, curve, time, bits, kind, SensorNoise() if noise == "camera" else None)
    config = load_config("default", {"schedule.iterations": iterations, "response.name": "srgb"})
    with tempfile.TemporaryDirectory() as folder:
        figures = evaluate(train(scene, Path(folder) / "run", config, device=device), scene)
    psnr_mu, regions = figures["protocol"]["gt-max"]["psnr_mu"], figures["regions"]
    place = {"scene": name, "exposure": exposure, "bits": bits, "kind": kind, "noise": noise, "hdr": psnr_mu}
    LOG.info("%s", place)
    return place | {region.replace("-", "_"): regions[region]["psnr_mu"]["gt-max"] for region in regions}


def photograph(truth: Scene, curve: Response, time: float, bits: int, kind: str, noise: SensorNoise | None) -> Scene:
    """Return the scene in photos of `bits` bits.

    kind: "linear" rounds before the curve, and the photos are read as RAW files are; "curve" rounds behind it.
    """
    levels, views, random = 2**bits - 1, [], np.random.default_rng(0)
    for view in truth.views:
        assert view.hdr is not None
        light = view.hdr.astype(np.float64) * time
        light = light if noise is None else noisy(light, 1.0, noise, random)
        if kind == "linear":
            codes = linear_codes(np.rint(np.clip(light, 0, 1) * levels) / levels)
        else:
            codes = codes_of(np.rint(np.asarray(curve.encode(light)) * levels) / levels, 16)
        # Without a source: views of an OpenEXR file are trained on as light, not as codes.
        views.append(replace(view, codes=codes, exposure_time=time, source=None))
    return replace(truth, views=tuple(views), response=curve, light_known=True)


if __name__ == "__main__":
    run(main)
