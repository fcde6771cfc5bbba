"""Choosing a response from one photo: the paper's score, and the linearity of colour mixtures at edges."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..errors import SehdrError
from .response import response_by_name, response_names
from .response_curve import Response

CODE = 1.0 / 255
# Edges: pixel pairs this far from the middle one; each end must be flat to 3 codes and 20 codes apart from the other.
EDGE_REACH, FLAT_CODES, EDGE_CODES = 2, 3, 20
# The two ends' encoded colours must not be one grey scaled: angle between them, in radians.
EDGE_ANGLE = 0.05
MAX_EDGES, MIN_EDGES = 5000, 50
# An edge that no mixture explains (a third surface, a highlight) counts no more than this.
MAX_RESIDUAL_CODES = 8.0


@dataclass(frozen=True)
class ResponseScore:
    """What the photo says about one candidate.

    dynamic_range: stops between the 0.1th and the 99.9th percentile of the decoded, unclipped values.
    roughness: mean absolute second difference of log2 of the decoded values, stops.
    paper_score: dynamic_range and minus roughness, each divided by its median over the candidates; larger is better.
    edge_deviation: RMS distance of an edge's middle colour from the mixtures of its two sides in linear light, in
        8-bit code values; smaller is better; NaN if the photo has fewer than 50 usable edges.
    """

    response: Response
    dynamic_range: float
    roughness: float
    paper_score: float
    edge_deviation: float


@dataclass(frozen=True)
class ResponseSelection:
    """The chosen response, by which score, and every candidate's scores, best first."""

    response: Response
    method: str
    edge_count: int
    scores: tuple[ResponseScore, ...]


def select_response(
    image, candidates: Sequence[Response] | None = None, *, method: str = "edges", seed: int = 0
) -> ResponseSelection:
    """The candidate under which a photo looks most like linear light.

    image: [H, W, 3] encoded values in [0, 1], NumPy array or tensor, as photographed: resampling in encoded values
        mixes colours in them, and the edges then tell of the resampling. Or a list of such images of one camera: their
        edges are pooled, and the paper's statistics are of the one with the most pixels neither black nor clipped.
    candidates: responses; by default the analytic bank. A DoRF file's are responses_in_file(path).
    method: "paper" is SeHDR, section 3.3: the curve of DoRF that does best "on a randomly sampled training image,
        evaluated by dynamic range and smoothness". The paper gives no formula; ours is ResponseScore.paper_score.
        "edges" is after Lin et al. 2004 (Radiometric calibration from a single image): at an edge between two evenly
        coloured regions a pixel is a mixture of both in linear light, so decoded colours lie on a line. Falls back to
        "paper", and says so in `method`, where the photo has fewer than 50 such edges.
    seed: of the sample of edges where there are more than 5000.

    Both find a curve only up to the exposure's scale, and neither is calibration: docs/method.md has measured errors.
    Raises SehdrError for an unknown method, no candidates, an image of another shape or with NaN, or under 100 pixels
    that are neither black nor clipped.
    """
    if method not in ("paper", "edges"):
        raise SehdrError(f"select_response: method = {method!r} is neither 'paper' nor 'edges'")
    if candidates is None:
        candidates = [response_by_name(name) for name in response_names()]
    if not candidates:
        raise SehdrError("select_response: there are no candidates; give at least one response")
    images = [_checked(each) for each in (image if isinstance(image, list | tuple) else [image])]
    clear = [((each > 1.5 * CODE) & (each < 1 - 4.5 * CODE)).all(axis=2) for each in images]
    if max(mask.sum() for mask in clear) < 100:
        raise SehdrError("select_response: under 100 pixels are neither black nor clipped; name a response instead")
    edges = np.concatenate([_edge_colours(*pair) for pair in zip(images, clear, strict=True)])
    if len(edges) > MAX_EDGES:
        edges = edges[np.random.default_rng(seed).choice(len(edges), MAX_EDGES, replace=False)]
    fullest = int(np.argmax([mask.sum() for mask in clear]))
    statistics = [
        (*_range_and_roughness(images[fullest], clear[fullest], each), _edge_deviation(edges, each))
        for each in candidates
    ]
    ranges, roughnesses, deviations = np.array(statistics).T
    paper = _relative(ranges) - _relative(roughnesses)
    if method == "edges" and np.isnan(deviations).all():
        method = "paper"
    goodness = paper if method == "paper" else -np.nan_to_num(deviations, nan=np.inf)
    scores = [
        ResponseScore(each, *map(float, row))
        for each, row in zip(candidates, zip(ranges, roughnesses, paper, deviations, strict=True), strict=True)
    ]
    order = np.argsort(-goodness, kind="stable")
    return ResponseSelection(candidates[order[0]], method, len(edges), tuple(scores[index] for index in order))


def _checked(image) -> np.ndarray:
    image = np.asarray(image.detach().cpu() if isinstance(image, torch.Tensor) else image, np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or not np.isfinite(image).all():
        raise SehdrError(f"select_response: an image of shape {list(image.shape)} is not [H, W, 3] of finite values")
    return image


def _relative(values: np.ndarray) -> np.ndarray:
    median = np.median(values)
    return values / median if median > 0 else np.zeros_like(values)


def _range_and_roughness(image, clear, response):
    exposure = response.decode(np.maximum(image, response.black + CODE))
    stops = np.log2(exposure)
    low, high = np.percentile(stops[clear], (0.1, 99.9))
    bends = []
    for axis in (0, 1):
        rows, known = np.moveaxis(stops, axis, 0), np.moveaxis(clear, axis, 0)
        bends.append(np.abs(rows[2:] - 2 * rows[1:-1] + rows[:-2])[known[2:] & known[1:-1] & known[:-2]].ravel())
    bends = np.concatenate(bends)
    return high - low, bends.mean() if len(bends) else 0.0


def _edge_colours(image, clear):
    """[E, 3, 3] encoded colours (one side, middle, other side) of clean, coloured edges along rows and columns."""
    found = []
    for axis in (0, 1):
        rows, known = np.moveaxis(image, axis, 0), np.moveaxis(clear, axis, 0)
        reach, length = EDGE_REACH, len(rows)
        if length < 2 * reach + 3:
            continue

        def at(offset, values=rows, margin=reach + 1, length=length):
            return values[margin + offset : length - margin + offset]

        first, middle, last = at(-reach), at(0), at(reach)
        flat = (np.abs(at(-reach - 1) - first).max(-1) <= FLAT_CODES * CODE) & (
            np.abs(at(reach + 1) - last).max(-1) <= FLAT_CODES * CODE
        )
        apart = np.abs(last - first).max(-1) >= EDGE_CODES * CODE
        # Between the sides in every channel, and well off both: another surface at the edge is not.
        between = ((middle - first) * (last - middle) >= -(CODE**2)).all(-1)
        share = np.linalg.norm(middle - first, axis=-1) / np.maximum(np.linalg.norm(last - first, axis=-1), CODE)
        cosine = (first * last).sum(-1) / (np.linalg.norm(first, axis=-1) * np.linalg.norm(last, axis=-1) + 1e-12)
        coloured = cosine < np.cos(EDGE_ANGLE)
        seen = at(-reach, known) & at(0, known) & at(reach, known)
        chosen = flat & apart & between & coloured & seen & (share > 0.15) & (share < 0.85)
        found.append(np.stack([first[chosen], middle[chosen], last[chosen]], axis=1))
    return np.concatenate(found) if found else np.zeros((0, 3, 3))


def _edge_deviation(edges, response):
    """RMS over edges of |W (middle - first - a (last - first))|, a the best for each edge, W = f' at the middle colour.

    W turns distances in linear light into code values, in which the photo's noise is alike for every candidate: a
    plain distance, or one divided by the line's length, prefers whichever curve crowds the colours together.
    """
    if len(edges) < MIN_EDGES:
        return np.nan
    first, middle, last = np.moveaxis(response.decode(np.maximum(edges, response.black + CODE)), 1, 0)
    slope = response.slope(middle)
    offset, line = slope * (middle - first), slope * (last - first)
    along = (offset * line).sum(1) / np.maximum((line**2).sum(1), 1e-300)
    residual = np.linalg.norm(offset - along[:, None] * line, axis=1) / CODE
    return float(np.sqrt(np.square(residual.clip(max=MAX_RESIDUAL_CODES)).mean()))
