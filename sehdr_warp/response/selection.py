"""A response from photos: by color mixtures at edges, the histogram and a prior; or by the paper's score.

Every candidate is a table of log exposure over the 8-bit codes, and the photos are edges and shares of codes; what
speaks for a candidate is computed for all of them at once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch

from ..errors import SehdrError
from ..rasterizer.warp_launch.threads import one_torch_thread
from .analytic import analytic_response
from .curve import Response
from .names import DESCRIPTIONS
from .table import TabulatedResponse

CODE = 1.0 / 255
# Edges: pixels this far on both sides of the middle one; each side must be flat to 3 codes and 20 from the other, with
# some slack for how a float rounds, and the sides' encoded colors at an angle (radians), not one gray scaled.
EDGE_REACH, FLAT_CODES, EDGE_CODES, SLACK, EDGE_ANGLE = 2, 3, 20, 0.25, 0.05
MAX_EDGES, MIN_EDGES = 4000, 50
# The middle lies between these shares of the way from one side to the other, in encoded values.
LEAST_SHARE, MOST_SHARE = 0.15, 0.85
# Variance of a stored value in codes^2: rounding, and a little for what two evenly colored sides still hide.
CODE_VARIANCE = 1 / 12 + 0.05
# Student's t: an edge that no mixture explains (a third surface, a highlight) costs a logarithm, not a square.
EDGE_FREEDOM = 2.0
# The variance off the line is this many times that of rounding (texture, denoised or compressed images), whichever is
# likeliest under a candidate.
EDGE_MISFITS = 2.0 ** np.arange(0, 8.5, 0.5)
# Edges of one set of photos share what is wrong with them: this many count as one, and more than 3000 count as 3000.
EDGES_PER_FACT, MOST_FACTS = 160.0, 3000 / 160.0
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
# How likely it is beforehand that no formula made the photos, and the probability from which a formula is taken for the
# truth (docs/response.md: set on half of the scenes and curves).
NO_FORMULA, DECISIVE = 0.5, 0.25
UNSURE = 0.4  # Stops of uncertainty from which a note says that the response is a guess
# Edges that are judged at once; photos larger than MOST_PIXELS are read in bands.
BATCH, MOST_PIXELS, BAND_ROWS = 256, 400_000, 32

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
    """Score of one candidate; nats are minus log likelihoods, so that smaller is better.

    Attributes:
        response: The candidate.
        dynamic_range: Stops between the 0.1th and 99.9th percentile of decoded, unclipped values.
        roughness: Mean absolute second difference of the logarithms (base 2) of decoded values.
        paper_score: Range minus roughness, each over its median among the candidates; larger is better.
        edges: Nats of an edge; NaN for under 50 usable ones.
        highlights: Nats of the pixels at and below the brightest code.
        span: Nats of the spread of log exposure.
        density: Nats of the density of log exposure.
        prior: Nats of the candidate before any photo.
        posterior: The sum, with edges times edge_facts(their number).
    """

    response: Response
    dynamic_range: float
    roughness: float
    paper_score: float
    edges: float
    highlights: float
    span: float
    density: float
    prior: float
    posterior: float


@dataclass(frozen=True)
class ResponseSelection:
    """The chosen response, by which score, and every candidate's scores, best first.

    uncertainty: stops; by how much curves that explain the photos as well differ from the chosen one: the root mean
    square over codes 10 to 245 and over the posterior, after one scale for each curve. NaN by "paper".
    """

    response: Response
    method: str
    edge_count: int
    scores: tuple[ResponseScore, ...]
    uncertainty: float

    @property
    def note(self) -> str | None:
        """A line that says how uncertain the response is; None if it is sure, or if nothing tells."""
        if not self.uncertainty > UNSURE:
            return None
        return (
            f"the response {self.response.name} is a guess: curves that explain the photos as well differ from it by "
            f"{self.uncertainty:.1f} stops between dark and bright; name it with --response, or measure it with "
            "`sehdr-warp calibrate`"
        )


def select_response(
    image,
    candidates: Sequence[Response] | None = None,
    *,
    method: str = "posterior",
    from_camera: bool = False,
    seed: int = 0,
) -> ResponseSelection:
    """Select the candidate under which photos look most like linear light, up to the exposure's scale.

    Args:
        image: [H, W, 3] codes of a photo, uint8 or uint16, or encoded values in [0, 1]; or several such photos
            of one camera, taken one by one. Resampling in encoded values mixes colors, which edges then tell of.
        candidates: by default the responses with a formula.
        method: "posterior" judges edges (Lin et al. 2004), clipped pixels, the spread and smoothness of light, and
            a prior; it needs none of them. Without `candidates`, and for photos that are not a camera's own, a smooth
            family of cameras' curves stands beside the formulae: a formula with a quarter of the posterior is taken;
            else the posterior's mean of log exposure at each code, a table that is none of the candidates.
            "paper" is SeHDR, section 3.3: the curve that does best on one photo "by dynamic range and smoothness"; the
            paper gives no formula, ours is ResponseScore.paper_score.
        from_camera: the photos are a camera's own JPEGs, with the prior of cameras.
        seed: of the sample of edges where there are more than 4000.

    Raises:
        SehdrError: for another method, no candidates, an image of another shape or not finite, or, by "paper", fewer
            than 100 pixels that are neither black nor clipped.
    """
    if method not in ("posterior", "paper"):
        raise SehdrError(f"select_response: method = {method!r} is neither posterior nor paper")
    beside = candidates is None and method == "posterior" and not from_camera
    candidates = [analytic_response(name) for name in DESCRIPTIONS] if candidates is None else candidates
    if not candidates:
        raise SehdrError("select_response: there are no candidates; give at least one response")
    photos = list(map(_bands, [image] if isinstance(image, np.ndarray) else image))
    usable = [sum(clear.sum() for _, clear in each) for each in photos]
    fullest = photos[int(np.argmax(usable))]
    if method == "paper" and max(usable) < 100:
        raise SehdrError("select_response: under 100 pixels are neither black nor clipped; name a response instead")
    bands = [band for each in photos for band in each]
    edges = np.concatenate([_edge_colors(*band) for band in bands])
    if len(edges) > MAX_EDGES:
        edges = edges[np.random.default_rng(seed).choice(len(edges), MAX_EDGES, replace=False)]
    codes = [np.rint(255 * values.clip(0, 1)).astype(int).ravel() for values, _ in bands]
    shares = np.bincount(np.concatenate(codes), minlength=256) / sum(map(len, codes))

    count = len(candidates)
    fine, rises = map(np.stack, zip(*map(_on_grid, candidates), strict=True))
    ranges, roughnesses = np.array([_range_and_roughness(fullest, each) for each in fine[:, ::FINE]]).T
    paper = _relative(ranges) - _relative(roughnesses)
    if beside:
        fine, rises = (np.concatenate(pair) for pair in zip((fine, rises), family_logs(), strict=True))
    logs = fine[:, ::FINE]
    with one_torch_thread():
        parts = _edges(edges, fine, rises), _highlights(shares, fine), _span(shares, logs), _density(shares, logs)
    evidence = np.nan_to_num(parts[0]) * edge_facts(len(edges)) + np.sum(parts[1:], axis=0)
    priors = np.array([_prior(each, from_camera) for each in candidates])
    posteriors = evidence[:count] + priors
    columns = ranges, roughnesses, paper, *(part[:count] for part in parts), priors, posteriors
    scores = [ResponseScore(*row) for row in zip(candidates, *(column.tolist() for column in columns), strict=True)]
    order = np.argsort(-paper if method == "paper" else posteriors, kind="stable")
    best = candidates[order[0]]
    costs = posteriors
    if beside:
        formula_scores = posteriors + np.log(np.exp(-priors).sum() / (1 - NO_FORMULA))
        costs = np.concatenate([formula_scores, evidence[count:] + np.log((len(logs) - count) / NO_FORMULA)])
    chances = np.exp(costs.min() - costs)
    chances /= chances.sum()
    if beside and chances[order[0]] < DECISIVE:
        best = TabulatedResponse("posterior mean", np.r_[0.0, np.exp(chances @ logs)[1:]], CODES)
    off = (logs - np.log(np.maximum(np.asarray(best.decode(CODES)), 1e-30)))[:, 10:246] / np.log(2)
    uncertainty = float(np.sqrt(chances @ off.var(1))) if method == "posterior" else math.nan
    return ResponseSelection(best, method, len(edges), tuple(scores[index] for index in order), uncertainty)


def edge_facts(count: int) -> float:
    """Return as how many independent observations `count` edges of one set of photos count."""
    return min(count / EDGES_PER_FACT, MOST_FACTS)


def _on_grid(response: Response) -> tuple[np.ndarray, np.ndarray]:
    """[2041] ln x at each place z of GRID, and d ln x / dz there; below code 1 all count as it."""
    values = np.maximum(GRID, response.black + CODE)
    return np.log(np.asarray(response.decode(values))), response.rise(values)


def _bands(image) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return a photo, or bands of a large one: encoded [h, W, 3] float64, and where neither black nor clipped."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3:
        raise SehdrError(f"select_response: an image of shape {list(image.shape)} is not [H, W, 3]")
    rows, columns = image.shape[:2]
    bands = [image]
    if rows * columns > MOST_PIXELS:
        starts = np.linspace(0, rows - BAND_ROWS, max(1, MOST_PIXELS // (BAND_ROWS * columns)))
        bands = [image[int(start) : int(start) + BAND_ROWS] for start in starts]
    white = np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1.0
    bands = [each / np.float64(white) for each in bands]
    if not all(np.isfinite(each).all() for each in bands):
        raise SehdrError("select_response: an image holds values that are not finite")
    return [(each, np.all((each > 1.5 * CODE) & (each < 1 - 4.5 * CODE), axis=2)) for each in bands]


def _prior(response: Response, from_camera: bool) -> float:
    if response.name not in DESCRIPTIONS:  # Given on purpose, and as likely as any.
        return 0.0
    if response.name == "linear":
        return LINEAR_PRIOR
    return (CAMERA_PRIOR if from_camera else PRIOR).get(response.name, UNLIKELY)


@cache
def family_logs() -> tuple[np.ndarray, np.ndarray]:
    """_on_grid, [512, 2041] each, of curves drawn from the family's prior; code 128 means what it does by `camera`."""
    z = np.maximum(GRID, 1 / 255)
    terms = np.stack([np.log(z), np.log(z + TOE), -np.log(1 + SHOULDER - z)])
    rises = np.stack([1 / z, 1 / (z + TOE), 1 / (1 + SHOULDER - z)])
    draws = MEAN + np.random.default_rng(0).normal(size=(2 * MEMBERS, 3)) @ SPREAD.T
    draws = draws[(draws @ rises).min(1) > LEAST_RISE][:MEMBERS]
    logs = draws @ terms
    middle = np.log(float(analytic_response("camera").decode(CODES[128])))
    return logs - logs[:, 128 * FINE, None] + middle, draws @ rises


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
    median = np.median(values)
    return values / median if median > 0 else np.zeros_like(values)


def _range_and_roughness(bands, logs: np.ndarray) -> tuple[float, float]:
    """In stops, of a photo under one candidate's log exposures [256]."""
    ranges, bends = [], []
    for values, clear in bands:
        stops = np.interp(values, CODES, logs) / np.log(2)
        ranges.append(stops[clear].ravel())
        for rows, valid in ((stops, clear), (stops.swapaxes(0, 1), clear.T)):
            bends.append(np.abs(np.diff(rows, 2, axis=0))[valid[2:] & valid[1:-1] & valid[:-2]].ravel())
    ranges, bends = np.concatenate(ranges), np.concatenate(bends)
    low, high = np.percentile(ranges, (0.1, 99.9)) if len(ranges) else (0.0, 0.0)
    return high - low, bends.mean() if len(bends) else 0.0


def _edge_colors(image: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """[E, 3, 3] encoded colors (one side, middle, other side) of clean, colored edges along rows and columns."""
    colors, length = [np.zeros((0, 3, 3))], 2 * EDGE_REACH + 3
    planes = np.ascontiguousarray(np.moveaxis(image, 2, 0))  # Sums over the first axis are many times as fast.
    for rows, valid in ((planes, clear), (planes.swapaxes(1, 2), clear.T)):
        starts = len(valid) - length + 1
        if starts < 1:
            continue
        at = [rows[:, k : k + starts] for k in range(length)]
        all_valid = np.logical_and.reduce([valid[k : k + starts] for k in range(1, length - 1, EDGE_REACH)])
        first, middle, last = at[1:-1:EDGE_REACH]
        flat = np.maximum(np.abs(at[0] - first), np.abs(at[-1] - last)).max(0) <= (FLAT_CODES + SLACK) * CODE
        apart = np.abs(last - first).max(0) >= (EDGE_CODES - SLACK) * CODE
        # Between the sides in every channel, and well off both: another surface at the edge is not.
        between = ((middle - first) * (last - middle) >= -(1 + SLACK) * CODE**2).all(0)
        share = np.linalg.norm(middle - first, axis=0) / np.maximum(np.linalg.norm(last - first, axis=0), CODE)
        cosine = (first * last).sum(0) / (np.linalg.norm(first, axis=0) * np.linalg.norm(last, axis=0) + 1e-12)
        mixed = (share > LEAST_SHARE) & (share < MOST_SHARE) & (cosine < np.cos(EDGE_ANGLE))
        edges = all_valid & flat & apart & between & mixed
        colors.append(np.stack([side[:, edges].T for side in (first, middle, last)], axis=1))
    return np.concatenate(colors)


def _edges(edges: np.ndarray, logs: np.ndarray, rises: np.ndarray) -> np.ndarray:
    """[K] mean over edges of minus the log likelihood, nats, in float32; NaN for too few. logs and rises: on GRID."""
    if len(edges) < MIN_EDGES:
        return np.full(len(logs), np.nan)
    # The three colors; of the channel that changes most, where the middle may lie (2), and the two sides.
    channel = np.abs(edges[:, 2] - edges[:, 0]).argmax(1)[:, None]
    first, last = (np.take_along_axis(edges[:, side], channel, 1) for side in (0, 2))
    limits = [first + share * (last - first) for share in (LEAST_SHARE, MOST_SHARE)]
    points = np.concatenate([edges.reshape(-1, 9), *limits, first, last], axis=1)
    place = torch.from_numpy(np.clip(points * 255, 1, 255) * FINE).float()
    below = place.floor().clamp_max(255 * FINE - 1).long()
    part = (place - below)[..., None]
    between = bool(part[:, :9].any())  # Codes of 8 bits are all on GRID.
    # Candidates last: a point reads one row of all of them, and every sum adds rows.
    exposures = torch.from_numpy(np.exp(logs).T).float().contiguous()
    slopes = 1 / (exposures * torch.from_numpy(rises.T).float())

    def read(table, where, between=True):
        rows = table[below[where]]
        return rows.lerp_(table[below[where] + 1], part[where]) if between else rows

    total = torch.zeros(len(EDGE_MISFITS), len(logs), dtype=torch.float64)
    for start in range(0, len(points), BATCH):
        colors, lines = ((slice(start, start + BATCH), part) for part in (slice(9), slice(9, 13)))
        total += _mixture_surprise(
            read(exposures, colors, between), read(slopes, colors, between), read(exposures, lines)
        )
    return (total / len(points)).amin(0).numpy()


def _mixture_surprise(exposures: torch.Tensor, slopes: torch.Tensor, lines: torch.Tensor) -> torch.Tensor:
    """Return sums [misfits, K] over E edges of the surprise of their mixed colors.

    The arguments are exposures and the curve's slopes [E, 9, K] at the nine colors, and exposures [E, 4, K] at the last
    points of _edges.

    The middle color's distance from the line of its two sides, in code values at the middle color, has the variance
    that rounding of all three gives it. Along the line every share of linear light within the limits is as likely.
    Both densities are normalized: else the curve that crowds colors together would win.
    """
    first, middle, last = exposures.unflatten(1, (3, 3)).unbind(1)
    slope_first, slope, slope_last = slopes.unflatten(1, (3, 3)).unbind(1)
    low, high, begin, end = lines.unbind(1)
    offset, line = slope * (middle - first) / CODE, slope * (last - first) / CODE
    share = ((offset * line).sum(1) / line.square().sum(1).clamp_min(1e-30))[:, None]
    variance = CODE_VARIANCE * (1 + ((1 - share) * slope / slope_first) ** 2 + (share * slope / slope_last) ** 2)
    weighted = (line.square() / variance).sum(1).clamp_min(1e-30)
    share = ((offset * line / variance).sum(1) / weighted)[:, None]
    distance = ((offset - share * line).square() / variance).sum(1)
    width = ((high - low) / (end - begin)).abs().clamp_min(1e-3)
    spread = 0.5 * (variance.log().sum(1) + weighted.log()) + width.log()
    # A sum of logarithms is that of products, of four, which stay below 1e38.
    tail, count = (EDGE_FREEDOM + 2) / 2, len(exposures)
    four = torch.nn.functional.pad(distance, (0, 0, 0, -count % 4)).unflatten(0, (4, -1)) / EDGE_FREEDOM
    costs = [tail * (four / misfit + 1).prod(0).log().sum(0) + count * np.log(misfit) for misfit in EDGE_MISFITS]
    return torch.stack(costs) + spread.sum(0)
