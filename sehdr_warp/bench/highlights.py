"""How far above white clipped light is: estimates from the photos alone, judged on the embedded scenes.

    python -m sehdr_warp.bench.highlights

Prints the table of docs/highlights.md. No training: what a photo does not clip counts as known up to an error of 38
dB, about that of a training on the truth, and every clipped channel of the held-out photos is set to white times
2^estimate. A gain is that of the mu-law PSNR (gt-max) over an estimate of 0, which is white.
"""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.optimize import minimize
from scipy.stats import norm

from ..response import response_by_name
from ..scene import load_scene
from ..synth.expose import expose, exposure_ladder
from ..training.config import LossConfig
from ..training.highlights import CHANNEL_PARTS, expected_excess, tail_stops
from ..training.prediction import kovaleski_oliveira

TUNED_ON = ("study", "lamps", "metal", "night")
OTHERS = ("glass", "sunlit", "window", "overcast")
CURVES = ("hdr-nerf", "camera", "srgb")
OTHER_ERRORS = 10**-3.8
FULL = 1 - 0.5 / 255
CONSTANTS = np.arange(0, 8, 0.1)


class Case:
    """A scene through a curve at one exposure: photos, and exposures in units of white."""

    def __init__(self, scene, response):
        self.response, self.train_views = response, scene.train_views
        self.photos, truths = ([], []), ([], [])
        for view in scene.views:
            part = int(view.split == "test")
            self.photos[part].append(view.image)
            truths[part].append(view.hdr * np.float32(view.exposure_time / response.white))
        self.truths = [np.stack(images) for images in truths]
        self.clipped = [np.stack(images) >= FULL for images in self.photos]
        self.excess = [
            np.log2(np.maximum(truth[clipped], 1e-9)) for truth, clipped in zip(self.truths, self.clipped, strict=True)
        ]
        self.counts = [clipped.sum(-1, keepdims=True).repeat(3, -1)[clipped] for clipped in self.clipped]
        self.tail = tail_stops(self.train_views, response)
        self.share = float(self.clipped[0].mean())

    def psnr(self, estimate) -> float:
        """Mean over the held-out views with clipped channels at `estimate` stops over white (one, or one for each)."""
        largest = self.truths[1].max(axis=(1, 2, 3), keepdims=True)
        guess = self.truths[1].copy()
        guess[self.clipped[1]] = 2.0 ** np.broadcast_to(estimate, self.excess[1].shape)
        errors = (mu_law(guess / largest) - mu_law(self.truths[1] / largest)) ** 2
        return float(np.mean(-10 * np.log10(errors.mean(axis=(1, 2, 3)) + OTHER_ERRORS)))


def mu_law(relative: np.ndarray) -> np.ndarray:
    return np.log1p(5000 * np.clip(relative, 0, 1)) / math.log(5001)


@cache
def tobit(case: Case) -> tuple[float, float]:
    """Mean and median excess of a normal distribution of log2 exposure, censored at black and white (Tobin 1958)."""
    photos = np.stack(case.photos[0])
    seen = photos[(photos < FULL) & (photos > 1 - FULL)]
    stops = np.log2(case.response.decode(seen) / case.response.white)
    black = math.log2(float(case.response.decode(1 - FULL)) / case.response.white)
    dark, bright = np.count_nonzero(photos <= 1 - FULL), np.count_nonzero(case.clipped[0])
    mean, square = stops.mean(), np.square(stops).mean()

    def surprise(values):
        centre, spread = values[0], math.exp(values[1])
        within = len(stops) * (values[1] + (square - 2 * mean * centre + centre**2) / (2 * spread**2))
        below, above = norm.logcdf((black - centre) / spread), norm.logsf(-centre / spread)
        return (within - dark * below - bright * above) / photos.size

    centre, spread = minimize(surprise, [mean, math.log(stops.std() + 0.1)], method="Nelder-Mead").x
    spread = math.exp(spread)
    ratio = math.exp(norm.logpdf(-centre / spread) - norm.logsf(-centre / spread))
    return centre + spread * ratio, centre + spread * norm.isf(norm.sf(-centre / spread) / 2)


def of_share(case: Case, spread: float) -> float:
    """Mean excess of a normal distribution of that spread, in stops, of which the clipped share lies above white."""
    place = norm.isf(min(case.share, 0.999))
    return spread * (norm.pdf(place) / norm.sf(place) - place)


def classical(case: Case) -> np.ndarray:
    light = np.stack([kovaleski_oliveira(photo, case.response) for photo in case.photos[1]]) / case.response.white
    return np.log2(np.maximum(light[case.clipped[1]], 1))


def fitted_by_count(cases: list[Case], weight: Callable[[Case], float]) -> np.ndarray:
    """[3] stops for one, two and three clipped channels, times weight(case), of the best PSNR: least squares over all
    cases, each weighted by the slope of its PSNR."""
    stops = np.ones(3)
    for _ in range(6):
        left, right = np.zeros(3), np.zeros(3)
        for case in cases:
            factor = weight(case)
            error = np.square(factor * stops[case.counts[0] - 1] - case.excess[0]).sum() / case.clipped[0].size
            slope = 1 / ((error * (math.log(2) / math.log(5001)) ** 2 + OTHER_ERRORS) * case.clipped[0].size)
            sums, numbers = (np.bincount(case.counts[0] - 1, values, 3) for values in (case.excess[0], None))
            left, right = left + slope * factor**2 * numbers, right + slope * factor * sums
        stops = right / left
    return stops


def main() -> None:
    cases = {}
    for name in (*TUNED_ON, *OTHERS):
        truth = load_scene(f"embedded:{name}", max_size=100)
        for curve in CURVES:
            response = response_by_name(curve)
            for index, time in enumerate(exposure_ladder(truth, response)):
                case = Case(expose(truth, response, time), response)
                if case.share >= 2e-4:
                    cases[name, curve, index] = case
    bases = {key: case.psnr(0.0) for key, case in cases.items()}

    def row(label: str, estimate: Callable[[Case], object]) -> None:
        gains = {key: case.psnr(estimate(case)) - bases[key] for key, case in cases.items()}
        shown = []
        for half in (TUNED_ON, OTHERS):
            # Cases that hardly clip count as no gain: the mean is over four scenes and five exposures.
            shown += [
                f"{sum(g for (n, c, _), g in gains.items() if n in half and c == curve) / 20:+.2f}" for curve in CURVES
            ]
            shown.append(f"{min(gain for (name, _, _), gain in gains.items() if name in half):+.2f}")
        window = gains["window", "hdr-nerf", 4]
        print(f"| {label} | {' | '.join(shown)} | {window:+.2f} |", flush=True)

    print("| estimate | " + " | ".join([*CURVES, "worst"] * 2) + " | window 4 |\n|---|" + "--:|" * 9)
    row("best constant of each case, from the truth", lambda c: max(CONSTANTS, key=c.psnr))
    for stops in (1.0, 1.5, 2.0, 3.0):
        row(f"{stops:g} stops", lambda c, stops=stops: stops)
    row("censored normal, mean", lambda c: tobit(c)[0])
    row("censored normal, median", lambda c: tobit(c)[1])
    row("exponential tail, at most 8 stops", lambda c: min(c.tail, 8))
    row("exponential tail, at most 3 stops", lambda c: min(c.tail, 3))
    for spread in (1.0, 2.0, 3.0):
        row(f"clipped share of a normal of {spread:g} stops", lambda c, spread=spread: of_share(c, spread))
    row("Kovaleski and Oliveira", classical)
    tuning = [case for (name, _, _), case in cases.items() if name in TUNED_ON]
    for label, weight in (
        ("by clipped channels", lambda c: 1.0),
        ("by clipped channels and tail", lambda c: min(c.tail / 2, 1.0)),
    ):
        stops = fitted_by_count(tuning, weight)
        shown = ", ".join(f"{value:.2f}" for value in stops)
        row(f"{label}: {shown}", lambda c, stops=stops, weight=weight: weight(c) * stops[c.counts[1] - 1])
        others = fitted_by_count([case for key, case in cases.items() if key[0] in OTHERS], weight)
        print(f"  (fitted to the other half: {', '.join(f'{value:.2f}' for value in others)})")
    prior = LossConfig(highlight_weight=1.0)
    row(
        f"as shipped: {', '.join(f'{part * prior.highlight_stops:.2f}' for part in CHANNEL_PARTS)}",
        lambda c: np.array(expected_excess(c.train_views, c.response, prior))[c.counts[1] - 1],
    )


if __name__ == "__main__":
    main()
