"""Scores of candidates for a camera's response: how likely photos are under each of them.

Every candidate is a table of log exposure over the codes; what speaks for a candidate is computed for all at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch

from ..rasterizer.warp_launch.threads import one_torch_thread
from .analytic import analytic_response
from .curve import Response
from .names import DESCRIPTIONS
from .selection_evidence import CODE, Band, PhotoEvidence

MIN_EDGES = 50  # Fewer edges are no evidence
# Variance of a stored value in codes^2: rounding, and a little for what two evenly colored sides still hide.
CODE_VARIANCE = 1 / 12 + 0.05
# Student's t: an edge that no mixture explains (a third surface, a highlight) costs a logarithm, not a square.
EDGE_FREEDOM = 2.0
# The variance off the line is this many times that of rounding (texture, denoised or compressed images), whichever is
# likeliest under a candidate.
EDGE_MISFITS = 2.0 ** np.arange(0, 8.5, 0.5)
# Shading at an edge, such as a contact shadow, scales the middle color: it leaves the line of its sides, but not their
# plane with black. The line says more of clean edges, so both count: the plane once, the line by this weight.
LINE_WEIGHT = 0.5
# Edges of one set of photos share what is wrong with them: this many count as one, and more than 1500 count as 1500.
EDGES_PER_FACT, MOST_FACTS = 80.0, 1500 / 80.0
# Radiance falls off above white by this natural log per stop, within a factor of 2.2 (one standard deviation).
HIGHLIGHT_RATE, HIGHLIGHT_SPREAD, HIGHLIGHT_FLOOR = 0.4, 0.8, 0.002
# Standard deviation of ln exposure over the values that are neither black nor white: 1.35, within a factor of 1.5.
SPAN, SPAN_SPREAD = 0.3, 0.4
# The density of log exposure, in bins of eight codes from 5.5 to 253.5. From one bin to the next ln density changes by
# DENSITY_SLOPE times their distance in stops, and by DENSITY_JUMP at any distance; the tails are Student's t. A bin
# with less than about DENSITY_SHARE of the values counts less, and BINS_PER_FACT neighbors count as one.
DENSITY_EDGES = np.arange(6, 255, 8)
DENSITY_SLOPE, DENSITY_JUMP, DENSITY_FREEDOM, DENSITY_SHARE = 0.9, 0.1, 5.0, 1e-3
BINS_PER_FACT = 4.0
# Minus log prior, up to a constant. Of photos that say nothing about where they come from ...
PRIOR = {"camera": 0.5, "srgb": 0.5, "rec709": 1.0, "gamma-2.2": 1.0, "hdr-nerf": 1.0, "filmic": 2.0, "aces": 2.0}
# ... and of a camera's own JPEG, which is sharpened and cleaned of noise: its edges mislead (docs/response.md).
CAMERA_PRIOR = {"camera": 0.0, "rec709": 1.0}
# Nobody stores 8-bit linear photos, and photos scaled down in encoded values have edges that are linear in them.
UNLIKELY, LINEAR_PRIOR = 12.0, 1000.0
BATCH = 256  # Edges that are scored at once

# The smooth family of cameras' curves, for photos that no response with a formula of its own explains:
# x(z) = z^p (z + TOE)^q (1 + SHOULDER - z)^-r up to scale, z the encoded value: p and p + q are the log-log slopes
# below and above the toe, r the roll-off into white. Least squares in log x over codes 10 to 245 leaves 0.02 stops on
# average of DoRF's curves (Grossberg and Nayar 2004).
TOE, SHOULDER = 0.08, 0.1
# Mean of (p, q, r) over 181 of DoRF's 201 curves fitted so, and the lower Cholesky factor of their covariance.
# The 20 others are those of docs/response.md.
MEAN = np.array([0.719, 0.591, 0.351])
SPREAD = np.array([[0.608, 0.0, 0.0], [-0.842, 0.727, 0.0], [-0.049, -0.123, 0.229]])
MEMBERS = 512
# Least d ln x / dz: a curve with less is not one that a camera has (a linear one has 1 at white).
LEAST_RISE = 0.15
CODES = np.arange(256) / 255
# Curves are read between codes too, at this many steps a code: an even number has the middle between two codes.
FINE = 8
GRID = np.arange(255 * FINE + 1) / (255 * FINE)


@dataclass(frozen=True)
class ResponseScore:
    """Score of one candidate; nats are minus log likelihoods, so that smaller is better."""

    response: Response  # The candidate
    dynamic_range: float  # Stops between the 0.1th and 99.9th percentile of decoded, unclipped values
    roughness: float  # Mean absolute second difference of the logarithms (base 2) of decoded values
    paper_score: float  # Range minus roughness, each over its median among the candidates; larger is better
    edges: float  # Nats of an edge; NaN for under 50 usable ones
    highlights: float  # Nats of the pixels at and below the brightest code
    span: float  # Nats of the spread of log exposure
    density: float  # Nats of the density of log exposure
    prior: float  # Nats of the candidate before any photo
    posterior: float  # The sum, with edges times edge_facts(their number)


class CurveTables(NamedTuple):
    """K curves on GRID."""

    logs: np.ndarray  # [K, 2041] natural log exposures
    rises: np.ndarray  # [K, 2041] their derivatives by the encoded value

    @property
    def at_codes(self) -> np.ndarray:
        """Natural log exposures [K, 256] at the codes."""
        return self.logs[:, ::FINE]

    def join(self, other: "CurveTables") -> "CurveTables":
        """Return these curves and then those of another table."""
        return CurveTables(np.concatenate([self.logs, other.logs]), np.concatenate([self.rises, other.rises]))


class Likelihoods(NamedTuple):
    """Minus log likelihoods [K] of the evidence under K curves, nats; see ResponseScore."""

    edges: np.ndarray
    highlights: np.ndarray
    span: np.ndarray
    density: np.ndarray

    def total(self, edge_count: int) -> np.ndarray:
        """Return the sum [K], with edges times edge_facts()."""
        return np.nan_to_num(self.edges) * edge_facts(edge_count) + np.sum(self[1:], axis=0)


def tabulate(candidates: Sequence[Response]) -> CurveTables:
    """Return the tables of candidates; below code 1 all values count as it."""
    logs, rises = [], []
    for response in candidates:
        values = np.maximum(GRID, response.black + CODE)
        logs.append(np.log(np.asarray(response.decode(values))))
        rises.append(response.rise(values))
    return CurveTables(np.stack(logs), np.stack(rises))


def likelihoods(evidence: PhotoEvidence, curves: CurveTables) -> Likelihoods:
    """Return how likely the evidence is under each curve."""
    shares, codes = evidence.shares, curves.at_codes
    with one_torch_thread():
        return Likelihoods(
            _edges(evidence.edges, curves.logs, curves.rises),
            _highlights(shares, curves.logs),
            _span(shares, codes),
            _density(shares, codes),
        )


def score_candidates(
    candidates: Sequence[Response],
    evidence: PhotoEvidence,
    curves: CurveTables,
    likely: Likelihoods,
    *,
    from_camera: bool,
) -> list[ResponseScore]:
    """Return the scores of K candidates, whose curves and likelihoods stand first in `curves` and `likely`."""
    count = len(candidates)
    figures = [_range_and_roughness(evidence.clearest, logs) for logs in curves.at_codes[:count]]
    ranges, roughnesses = np.array(figures).T
    paper = _relative(ranges) - _relative(roughnesses)
    priors = np.array([minus_log_prior(response, from_camera=from_camera) for response in candidates])
    posteriors = likely.total(len(evidence.edges))[:count] + priors
    columns = ranges, roughnesses, paper, *likely, priors, posteriors  # In the order of ResponseScore's fields.
    return [ResponseScore(response, *(float(column[k]) for column in columns)) for k, response in enumerate(candidates)]


def edge_facts(count: int) -> float:
    """Return as how many independent observations `count` edges of one set of photos count."""
    return min(count / EDGES_PER_FACT, MOST_FACTS)


def minus_log_prior(response: Response, *, from_camera: bool) -> float:
    """Return the nats of a candidate before any photo."""
    if response.name not in DESCRIPTIONS:  # Named on purpose, and as likely as any.
        return 0.0
    if response.name == "linear":
        return LINEAR_PRIOR
    return (CAMERA_PRIOR if from_camera else PRIOR).get(response.name, UNLIKELY)


@cache
def family_curves() -> CurveTables:
    """Return 512 curves drawn from the family's prior; code 128 has the exposure that it has by `camera`."""
    z = np.maximum(GRID, 1 / 255)
    terms = np.stack([np.log(z), np.log(z + TOE), -np.log(1 + SHOULDER - z)])
    rises = np.stack([1 / z, 1 / (z + TOE), 1 / (1 + SHOULDER - z)])
    draws = MEAN + np.random.default_rng(0).normal(size=(2 * MEMBERS, 3)) @ SPREAD.T
    draws = draws[(draws @ rises).min(1) > LEAST_RISE][:MEMBERS]
    logs = draws @ terms
    middle = np.log(float(analytic_response("camera").decode(CODES[128])))
    return CurveTables(logs - logs[:, 128 * FINE, None] + middle, draws @ rises)


# Minus log likelihoods [K] from the shares of values at the codes [256] and the codes' natural log exposures [K, 256].


def _highlights(shares: np.ndarray, fine: np.ndarray) -> np.ndarray:
    """Return minus log likelihoods by the shares of values at the brightest code and at the nine codes below it.

    If radiance falls off as exp(-rate stops) over the S stops of the nine codes and beyond, near / (white + near) is
    1 - exp(-rate S): a camera that clips piles values up at white, others spread them. The rate is log-normal.
    fine: ln x on GRID.
    """
    stops = (fine[:, 509 * FINE // 2] - fine[:, 491 * FINE // 2]) / np.log(2)
    white, near = shares[255] + HIGHLIGHT_FLOOR / 2, shares[246:255].sum() + HIGHLIGHT_FLOOR / 2
    rate = np.log1p(near / white) / np.maximum(stops, 1e-6)
    spread = HIGHLIGHT_SPREAD**2 + HIGHLIGHT_FLOOR / (shares[246:].sum() + 1e-9)
    return 0.5 * np.log(rate / HIGHLIGHT_RATE) ** 2 / spread


def _span(shares: np.ndarray, logs: np.ndarray) -> np.ndarray:
    """Return minus log likelihoods by the spread of ln exposure, which is similar in most scenes.

    A wrong curve stretches or compresses it. The standard deviation is log-normal; its weight is the share of values
    between black and white.
    """
    inside, logs = shares[1:255].sum(), logs[:, 1:255]
    if inside <= 0:
        return np.zeros(len(logs))
    weights = shares[1:255] / inside
    variance = np.square(logs - (logs @ weights)[:, None]) @ weights
    off = 0.5 * np.log(np.maximum(variance, np.exp(-6.0))) - SPAN
    return 0.5 * inside * (off / SPAN_SPREAD) ** 2


def _density(shares: np.ndarray, logs: np.ndarray) -> np.ndarray:
    """Return minus log likelihoods by the density of log exposure, which is smooth unless the curve is wrong."""
    edges = 0.5 * (logs[:, DENSITY_EDGES - 1] + logs[:, DENSITY_EDGES]) / np.log(2)
    widths = np.maximum(np.diff(edges), 1e-6)
    counts = np.add.reduceat(shares, DENSITY_EDGES)[:-1]
    change = np.diff(np.log(counts + 0.01 * DENSITY_SHARE) - np.log(widths))
    apart = 0.5 * (widths[:, 1:] + widths[:, :-1])
    variance = (DENSITY_SLOPE * apart) ** 2 + DENSITY_JUMP**2
    least = np.minimum(counts[1:], counts[:-1])
    tail = (DENSITY_FREEDOM + 1) / 2
    costs = tail * np.log1p(change**2 / (DENSITY_FREEDOM * variance)) + 0.5 * np.log(variance)
    return costs @ (least / (least + DENSITY_SHARE)) / BINS_PER_FACT


def _relative(values: np.ndarray) -> np.ndarray:
    """Return values over their median."""
    median = np.median(values)
    return values / median if median > 0 else np.zeros_like(values)


def _range_and_roughness(bands: Sequence[Band], logs: np.ndarray) -> tuple[float, float]:
    """Return dynamic range and roughness, in stops, of a photo under one candidate's log exposures [256]."""
    ranges, bends = [], []
    for band in bands:
        stops, clear = np.interp(band.encoded, CODES, logs) / np.log(2), band.clear
        ranges.append(stops[clear].ravel())
        for rows, valid in ((stops, clear), (stops.swapaxes(0, 1), clear.T)):
            bends.append(np.abs(np.diff(rows, 2, axis=0))[valid[2:] & valid[1:-1] & valid[:-2]].ravel())
    ranges, bends = np.concatenate(ranges), np.concatenate(bends)
    low, high = np.percentile(ranges, (0.1, 99.9)) if len(ranges) else (0.0, 0.0)
    return high - low, bends.mean() if len(bends) else 0.0


def _edges(edges: np.ndarray, logs: np.ndarray, rises: np.ndarray) -> np.ndarray:
    """Return the mean [K] over edges of minus the log likelihood, nats, in float32; NaN for too few edges.

    logs and rises [K, 2041] are on GRID.
    """
    if len(edges) < MIN_EDGES:
        return np.full(len(logs), np.nan)
    place = torch.from_numpy(np.clip(edges.reshape(-1, 9) * 255, 1, 255) * FINE).float()
    below = place.floor().clamp_max(255 * FINE - 1).long()
    part = (place - below)[..., None]
    between = bool(part.any())  # Codes of 8 bits are all on GRID.
    # Candidates last: a point reads one row of all of them, and every sum adds rows.
    exposures = torch.from_numpy(np.exp(logs).T).float().contiguous()
    slopes = 1 / (exposures * torch.from_numpy(rises.T).float())

    def read(table: torch.Tensor, batch: slice) -> torch.Tensor:
        rows = table[below[batch]]
        rows = rows.lerp_(table[below[batch] + 1], part[batch]) if between else rows
        return rows.unflatten(1, (3, 3))

    total = torch.zeros(2, len(EDGE_MISFITS), len(logs), dtype=torch.float64)
    for start in range(0, len(edges), BATCH):
        batch = slice(start, start + BATCH)
        colors, code_slopes = read(exposures, batch), read(slopes, batch) / CODE
        total[0] += _line_surprise(colors, code_slopes)
        total[1] += _plane_surprise(colors, code_slopes)
    line, plane = (total / len(edges)).amin(1).numpy()
    return LINE_WEIGHT * line + plane


# Sums [misfits, K] over E edges of the surprise of their mixed colors; linear colors [E, 3, 3, K] (one side, middle,
# other side; channels), and codes by exposure there. The distance counts in codes of the middle color, and has the
# variance that rounding of all three colors gives it. Densities are normalized: else the curve that crowds colors
# together would win.


def _line_surprise(colors: torch.Tensor, slopes: torch.Tensor) -> torch.Tensor:
    """Return the surprise of the middle color's distance from the line of its two sides."""
    first, middle, last = colors.unbind(1)
    slope_first, slope, slope_last = slopes.unbind(1)
    offset, line = slope * (middle - first), slope * (last - first)
    length = line.square().sum(1).clamp_min(1e-30)
    share = ((offset * line).sum(1) / length)[:, None]
    variance = CODE_VARIANCE * (1 + ((1 - share) * slope / slope_first) ** 2 + (share * slope / slope_last) ** 2)
    weighted = (line.square() / variance).sum(1).clamp_min(1e-30)
    share = ((offset * line / variance).sum(1) / weighted)[:, None]
    distance = ((offset - share * line).square() / variance).sum(1)
    spread = 0.5 * (variance.log().sum(1) + weighted.log() - length.log())
    return _student(distance, 2) + spread.sum(0)


def _plane_surprise(colors: torch.Tensor, slopes: torch.Tensor) -> torch.Tensor:
    """Return the surprise of the middle color's distance from the plane of its two sides and black."""
    lengths = colors.square().sum(2, keepdim=True).sqrt()
    first, middle, last = (colors / lengths).unbind(1)
    step_first, step, step_last = (1 / (slopes * lengths)).unbind(1)  # Of one code.
    normal = _cross(first, last)
    own = (normal * step).square().sum(1).clamp_min(1e-20)
    sides = (_cross(last, middle) * step_first).square().sum(1)
    sides += (_cross(middle, first) * step_last).square().sum(1)
    variance = CODE_VARIANCE * (own + sides)
    spread = 0.5 * (variance.log() - own.log())
    return _student((normal * middle).sum(1).square() / variance, 1) + spread.sum(0)


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the cross products of [E, 3, K], several times as fast as torch's."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _student(distance: torch.Tensor, dimensions: int) -> torch.Tensor:
    """Return sums [misfits, K] over squared distances [E, K] of minus the log density, up to a constant."""
    # A sum of logarithms is that of products, of four, which stay below 1e38.
    four = torch.nn.functional.pad(distance, (0, 0, 0, -len(distance) % 4)).unflatten(0, (4, -1)) / EDGE_FREEDOM
    tail, widening = (EDGE_FREEDOM + dimensions) / 2, len(distance) * dimensions / 2
    return torch.stack(
        [tail * (four / misfit + 1).prod(0).log().sum(0) + widening * np.log(misfit) for misfit in EDGE_MISFITS]
    )
