"""Judge the prior for clipped light on exposure stacks by real cameras.

`python -m priors.brackets STACKS --out priors/brackets.json`; STACKS holds a folder for each stack, whose photos state
their times by EXIF or an exposures.json. The stack calibrates its camera, and its darker photos show what clips in the
brighter ones.
"""

import itertools
import json
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.results import new_result
from benchmarks.study import run
from sehdr_warp.errors import InputError
from sehdr_warp.prior import load_prior
from sehdr_warp.prior.estimate import LARGEST, VARIANCE_SHARE, LightPrior
from sehdr_warp.response import Response
from sehdr_warp.response.calibration import calibrate_codes
from sehdr_warp.scene.exposure.stack import read_stack
from sehdr_warp.scene.images.ldr_files import read_ldr

log = logging.getLogger("brackets")

SHARES = (0.001, 0.01, 0.03, 0.1, 0.3)  # Borders of the rows: share of a photo's pixels that clip
SIDE = 1000  # Pixels of the longer side that are read of a photo, evenly spaced
WHITE, BLACK = 254, 6  # 8-bit codes from which a value clips, and up to which it says too little
DARKER = 3  # Photos of a stack that must be darker
MOST_UNKNOWN = 0.1  # Share of a photo's clipped values that no darker photo may show


@dataclass(frozen=True)
class Exposure:
    """One photo of a stack at the size that the network sees, [h, w, 3] each."""

    seconds: float  # Its exposure time
    exposure: np.ndarray  # Mean decoded values, in multiples of white
    clipped: np.ndarray  # Share of a pixel's area that clips
    black: np.ndarray  # Share of a pixel's area that is nearly black


def read_exposures(folder: Path) -> list[Exposure]:
    """Read a stack, by the response that it determines, darkest first.

    Raises:
        InputError: if it determines none, or its photos differ in size.
    """
    files, times = read_stack(folder)
    order = np.argsort(times)
    photos = [_codes(files[index]) for index in order]
    seconds = [float(times[index]) for index in order]
    response = calibrate_codes(photos, seconds, name=str(folder)).response
    return [_reduced(photo, time, response) for photo, time in zip(photos, seconds, strict=True)]


def merge(exposures: list[Exposure]) -> np.ndarray:
    """Return the radiance [h, w, 3] of a stack in multiples of white in a second; NaN where all photos clip.

    Photos weigh by their time where they neither clip nor are black; else the darkest counts if it does not clip.
    """
    light, weight = (np.zeros_like(exposures[0].exposure) for _ in range(2))
    for each in exposures:
        usable = (each.clipped == 0) & (each.black < 0.5)
        light += usable * each.exposure
        weight += usable * each.seconds
    darkest = exposures[0]
    fallback = np.where(darkest.clipped == 0, darkest.exposure / darkest.seconds, np.nan)
    return np.where(weight > 0, light / np.maximum(weight, 1e-30), fallback)


def judge_photo(prior: LightPrior, photo: Exposure, radiance: np.ndarray) -> dict | None:
    """Return figures of the estimates for one photo; None if too few of its clipped values are known.

    share: of its pixels that clip. values: clipped values that are known. rms, bias, within: of the log2 excess over
    white, stops. light: log2 of the expected over the true light of these values. The last two also for `white`.
    red_blue: of differences of red and blue, summed: true times estimated, true squared, and estimated squared.
    """
    clipped = photo.clipped >= 0.5
    share = float(clipped.any(2).mean())
    truth = np.log2(np.maximum(radiance * photo.seconds, 1.0))
    known = clipped & np.isfinite(truth)
    if not SHARES[0] <= share < SHARES[-1] or known.sum() < max(10, (1 - MOST_UNKNOWN) * clipped.sum()):
        return None
    exposure = torch.from_numpy(np.minimum(photo.exposure, 1.0)).float()
    estimate = prior.estimate(exposure, torch.from_numpy(clipped))
    means, deviations = estimate.mean.numpy(), estimate.deviation.numpy()
    true, mean, deviation = truth[known], means[known], deviations[known]
    expected = np.exp2(mean + VARIANCE_SHARE * np.log(2) * deviation**2 / 2)
    light = np.exp2(true).sum()
    whole = known.all(2)
    colors = [(values[..., 0] - values[..., 2])[whole] for values in (truth, means)]
    return {
        "share": share,
        "values": int(known.sum()),
        "rms": float(np.sqrt(np.square(mean - true).mean())),
        "white_rms": float(np.sqrt(np.square(true).mean())),
        "bias": float((mean - true).mean()),
        "within": float((np.abs(mean - true) <= deviation).mean()),
        "light": float(np.log2(expected.sum() / light)),
        "white_light": float(np.log2(len(true) / light)),
        "red_blue": [float(colors[0] @ colors[1]), float(colors[0] @ colors[0]), float(colors[1] @ colors[1])],
    }


def rows_by_share(photos: list[dict]) -> list[dict]:
    """Return a row for each range of SHARES: stacks count alike, and so do the photos of a stack."""
    rows = []
    for least, most in itertools.pairwise(SHARES):
        part = [photo for photo in photos if least <= photo["share"] < most]
        stacks = sorted({photo["stack"] for photo in part})
        if not stacks:
            continue
        groups = [[photo for photo in part if photo["stack"] == stack] for stack in stacks]
        row = {"least": least, "most": most, "stacks": len(stacks), "photos": len(part)}
        for name in ("rms", "white_rms"):
            row[name] = float(np.sqrt(np.mean([np.mean([photo[name] ** 2 for photo in group]) for group in groups])))
        for name in ("bias", "within"):
            row[name] = float(np.mean([np.mean([photo[name] for photo in group]) for group in groups]))
        for name in ("light", "white_light"):
            row[name] = float(np.median([np.median([abs(photo[name]) for photo in group]) for group in groups]))
        rows.append(row)
    return rows


def main(stacks: Path, /, out: Path, weights: Path | None = None) -> None:
    """Judge the prior on exposure stacks and write the figures.

    Args:
        stacks: folder with a folder of photos for each stack.
        out: JSON file of the figures.
        weights: of another prior than the package's.
    """
    prior = load_prior("cpu") if weights is None else load_prior("cpu", weights)
    photos: list[dict] = []
    for folder in sorted(path for path in stacks.iterdir() if path.is_dir()):
        try:
            exposures = read_exposures(folder)
        except InputError as error:
            log.info("%s", error)
            continue
        radiance = merge(exposures)
        figures = [judge_photo(prior, photo, radiance) for photo in exposures[DARKER:]]
        photos += [row | {"stack": folder.name} for row in figures if row is not None]
        log.info("%s: %d photos", folder.name, sum(row is not None for row in figures))
    product, true, estimated = np.sum([photo["red_blue"] for photo in photos], axis=0) if photos else (0.0, 0.0, 0.0)
    colors = {
        "slope": float(product / max(true, 1e-9)),
        "correlation": float(product / max((true * estimated) ** 0.5, 1e-9)),
    }
    result = new_result("prior on exposure stacks", torch.device("cpu"), {})
    out.write_text(json.dumps(result | {"rows": rows_by_share(photos), "colors": colors, "photos": photos}))


def _codes(path: Path) -> np.ndarray:
    """Return 8-bit codes [H, W, 3] of a photo, of at most SIDE pixels a side."""
    pixels = read_ldr(path, oriented=True).pixels
    step = -(-max(pixels.shape) // SIDE)
    pixels = pixels[::step, ::step]
    return pixels if pixels.dtype == np.uint8 else np.rint(pixels / 257.0).astype(np.uint8)


def _reduced(codes: np.ndarray, seconds: float, response: Response) -> Exposure:
    """Return a photo averaged in linear light to at most LARGEST pixels a side."""
    factor = -(-max(codes.shape) // LARGEST)
    table = (response.decode(np.arange(256) / 255) / response.white).astype(np.float32)

    def averaged(values: np.ndarray) -> np.ndarray:
        height, width = (side // factor for side in values.shape[:2])
        blocks = values[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
        return blocks.mean((1, 3), dtype=np.float64)

    return Exposure(seconds, averaged(table[codes]), averaged(codes >= WHITE), averaged(codes <= BLACK))


if __name__ == "__main__":
    run(main)
