"""Compare the prior for clipped light on panoramas with white, a constant and a ridge regression.

`python -m priors.judge PACK WEIGHTS --out FIGURES.json` judges weights of `priors.train --judge` again. With `--folder`
it judges any weights on the panoramas of a folder, such as those that sources.toml lists as `checked`.
"""

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.results import new_result
from benchmarks.study import run
from sehdr_warp.prior import load_prior
from sehdr_warp.prior.network import STOPS, LightNetwork, network_input

from .families import LIT
from .panoramas import Pack, pack_of_folder, read_pack
from .photos import Camera, Photos
from .rooms import LitRooms

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
PHOTOS, BATCH, SIZE = 384, 32, 96
LIT_ROOMS = 50  # Other ones than those of a training
RIDGE = 10.0
SETS = {
    "plain": {},
    "camera": {},
    "bright lamps": {"stretch_share": 1.0},
    "lights put in": {"light_share": 1.0},
    "overexposed": {"overexposed_share": 1.0},
    "pages": {"page_share": 1.0},
    "lit rooms": {"darkest": LIT["darkest"]},
}
"""Names of the sets of photos, and what is in them beside what the panoramas hold."""
AREAS = (30, 300, 3000, 3 * SIZE**2)  # Most clipped values of a photo in a row of energies
MU = 5000.0


def judge(
    network: LightNetwork,
    scale: float,
    pack: Pack,
    unseen: np.ndarray,
    chosen: np.ndarray,
    *,
    seed: int,
    device: str,
    learned: Pack | None = None,
) -> dict:
    """Return figures of each estimate on photos of unseen panoramas.

    Photos are plain (sRGB, no noise), by cameras, by cameras with lamps brighter than in the panoramas, with lamps,
    windows and screens put in, overexposed, with a white surface put in that is no lamp, and of rooms with lamps.

    The panoramas `chosen`, of the pack `learned` if it is another one, are those that constant and ridge are fitted on.

    For each estimate: rms (stops, all clipped values alike), level (spread of the mean error of photos, stops), light
    (median over photos of |log2| of total clipped light over the truth), psnr and worst (mu-law dB over whole photos,
    mean and mean of the worst 5 %). For the network also calibration: the share within one deviation, and by deviation;
    energy: expected over true light of all photos together, by the number of values that a photo clips (AREAS).
    """
    examples = _collect(network, learned or pack, chosen, seed + 100, device, plain=True)
    result = {}
    for name, shares in SETS.items():
        if name == "lit rooms":
            shares = shares | {"lit_rooms": LitRooms(LIT_ROOMS, device, seed + 1000)}
        photos = _collect(network, pack, unseen, seed, device, plain=name == "plain", **shares)
        constant = float(np.mean(list(examples["level"])))
        ridge = _ridge(examples["cues"], examples["level"])
        guesses = {
            "white": [np.zeros_like(t) for t in photos["truth"]],
            "constant": [np.full_like(t, constant) for t in photos["truth"]],
            "ridge": [
                np.full_like(t, max(0.0, float(ridge(c)))) for t, c in zip(photos["truth"], photos["cues"], strict=True)
            ],
            "network": photos["mean"],
        }
        figures = {guess: _figures(values, photos) for guess, values in guesses.items()}
        error = np.concatenate([m - t for m, t in zip(photos["mean"], photos["truth"], strict=True)])
        deviation = scale * np.concatenate(photos["deviation"])
        figures["network"]["within_one_deviation"] = float((np.abs(error) <= deviation).mean())
        figures["network"]["energy"] = _energy(photos, scale)
        edges = np.quantile(deviation, [0, 0.25, 0.5, 0.75, 1])
        figures["network"]["by_deviation"] = [
            {
                "deviation": float(deviation[part].mean()),
                "rms": float(np.sqrt((error[part] ** 2).mean())),
                "within": float((np.abs(error[part]) <= deviation[part]).mean()),
            }
            for low, high in itertools.pairwise(edges)
            if (part := (deviation >= low) & (deviation <= high)).any()
        ]
        if name == "camera":
            rng = np.random.default_rng(0)
            sample = rng.choice(len(error), min(2000, len(error)), replace=False)
            truth = np.concatenate(photos["truth"])
            points = np.stack([truth[sample], truth[sample] + error[sample], deviation[sample]], 1)
            figures["network"]["sample"] = np.round(points.astype(float), 3).tolist()
        result[name] = figures
    return result


def main(pack: Path, weights: Path, /, out: Path, folder: Path | None = None, device: str = DEVICE) -> None:
    """Judge weights and write the figures.

    Args:
        pack: the panoramas.
        weights: of the prior.
        out: JSON file of the figures.
        folder: judge on the .hdr and .exr panoramas of a folder instead.
        device: cpu or cuda:N.
    """
    learned, prior = read_pack(pack), load_prior(device, weights)
    judged, unseen, chosen = learned, np.flatnonzero(learned.held_out), np.flatnonzero(~learned.held_out)
    if folder:
        judged = pack_of_folder(folder, learned)
        unseen = np.arange(len(judged.panoramas))
    figures = judge(
        prior.network, prior.deviation_scale, judged, unseen, chosen, seed=2, device=device, learned=learned
    )
    result = new_result("prior on panoramas", torch.device(device), {"panoramas": len(unseen)})
    out.write_text(json.dumps(result | figures))


@torch.no_grad()
def _collect(
    network: LightNetwork, pack: Pack, chosen: np.ndarray, seed: int, device: str, *, plain: bool, **shares: Any
) -> dict:
    """Return lists over photos: truth, mean and deviation of clipped values, cues, and what else figures need.

    shares: of Camera; without them the photos hold what the panoramas do.
    """
    camera = Camera(pack, device, chosen, rooms=False, seed=seed, **shares)
    pixels: dict = {name: [] for name in ("truth", "mean", "deviation", "cues", "level", "clipped", "exposure")}
    for _ in range(PHOTOS // BATCH):
        photos = camera.take(BATCH, SIZE, plain=plain)
        mean, deviation = network(network_input(photos.exposure, photos.clipped))
        for k in range(BATCH):
            clipped = photos.clipped[k] > 0
            middle, share = float(photos.exposure[k].amax(0).median()), float(clipped.any(0).float().mean())
            if int(clipped.sum()) < 5 or (plain and not (0.01 < middle < 0.7 and share >= 0.001)):
                continue
            truth = photos.truth[k][clipped].cpu().numpy()
            pixels["truth"].append(truth)
            pixels["mean"].append(mean[k][clipped].cpu().numpy())
            pixels["deviation"].append(deviation[k][clipped].cpu().numpy())
            pixels["cues"].append(_cues(photos, k))
            pixels["level"].append(float(truth.mean()))
            pixels["clipped"].append(clipped.cpu().numpy())
            pixels["exposure"].append(torch.where(clipped, 1.0, photos.exposure[k].clamp(0, 1)).cpu().numpy())
    return pixels


def _energy(photos: dict, scale: float) -> dict[str, float]:
    """Return expected over true light by the number of clipped values, as a training expects it.

    The expected light is the mean of a log-normal value. Truth above STOPS counts as STOPS.
    """
    counts = np.array([len(truth) for truth in photos["truth"]])
    true = np.array([np.exp2(np.minimum(truth, STOPS)).sum() for truth in photos["truth"]])
    expected = np.array(
        [
            np.exp2(mean + (scale * deviation) ** 2 * np.log(2) / 2).sum()
            for mean, deviation in zip(photos["mean"], photos["deviation"], strict=True)
        ]
    )
    pairs = itertools.pairwise((0, *AREAS))
    parts = {most: (counts > least) & (counts <= most) for least, most in pairs}
    return {str(most): float(expected[part].sum() / max(true[part].sum(), 1e-9)) for most, part in parts.items()}


def _cues(photos: Photos, k: int) -> np.ndarray:
    """Return ten figures of a photo's histogram."""
    logarithms = photos.exposure[k].amax(0).clamp_min(2.0**-12).log2()
    some = photos.clipped[k].amax(0)
    total = some.mean()
    values: list[Tensor] = [total, (total + 1e-4).log(), photos.clipped[k].amin(0).sum() / some.sum().clamp_min(1)]
    values += list(torch.quantile(logarithms, logarithms.new_tensor([0.1, 0.5, 0.75, 0.9, 0.95])))
    near = logarithms[some == 0]
    values += [(near > -0.5).float().mean(), (near > -1.0).float().mean()] if len(near) else [total, total]
    return torch.stack([v.float() for v in values]).cpu().numpy()


def _ridge(cues: list[np.ndarray], levels: list[float]):
    """Return the regression of photos' mean excess on their cues, as a function of cues."""
    x, y = np.array(cues), np.array(levels)
    middle, spread = x.mean(0), x.std(0) + 1e-9
    x = np.c_[np.ones(len(x)), (x - middle) / spread]
    penalty = RIDGE * np.eye(x.shape[1])
    penalty[0, 0] = 0
    weights = np.linalg.solve(x.T @ x + penalty, x.T @ y)
    return lambda c: weights[0] + weights[1:] @ ((c - middle) / spread)


def _figures(guesses: list[np.ndarray], photos: dict) -> dict:
    truths = photos["truth"]
    errors = [g - t for g, t in zip(guesses, truths, strict=True)]
    light = [abs(np.log2(np.exp2(g).sum() / np.exp2(t).sum())) for g, t in zip(guesses, truths, strict=True)]
    pairs = zip(guesses, truths, photos["clipped"], photos["exposure"], strict=True)
    psnr = np.sort([_psnr(g, t, clipped, exposure) for g, t, clipped, exposure in pairs])
    return {
        "photos": len(truths),
        "rms": float(np.sqrt((np.concatenate(errors) ** 2).mean())),
        "level": float(np.std([e.mean() for e in errors])),
        "light": float(np.median(light)),
        "psnr": float(psnr.mean()),
        "worst": float(psnr[: max(1, len(psnr) // 20)].mean()),
    }


def _psnr(guess: np.ndarray, truth: np.ndarray, clipped: np.ndarray, exposure: np.ndarray) -> float:
    """Return the mu-law PSNR of a photo with its clipped values at a guess; what is not clipped counts as right."""
    largest = float(np.exp2(truth.max()))
    error = np.zeros_like(exposure)
    ours, true = (np.log1p(MU * np.minimum(np.exp2(v) / largest, 1)) / np.log1p(MU) for v in (guess, truth))
    error[clipped] = ours - true
    return float(-10 * np.log10(max((error**2).mean(), 1e-9)))


if __name__ == "__main__":
    run(main)
