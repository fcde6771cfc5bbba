"""A response from photos: by color mixtures at edges, the histogram and a prior; or by the paper's score.

selection_evidence.py collects evidence from photos, selection_scores.py scores candidates by it, and select_response()
chooses.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import SehdrError
from .analytic import analytic_response
from .curve import Response
from .names import DESCRIPTIONS
from .selection_evidence import collect_evidence
from .selection_scores import CODES, ResponseScore, family_curves, likelihoods, score_candidates, tabulate
from .table import TabulatedResponse

# How likely it is beforehand that no formula made the photos, and the probability from which a formula is taken for the
# truth (set on the 72 sets of docs/reports/response.md).
NO_FORMULA, DECISIVE = 0.5, 0.2
UNSURE = 0.4  # Stops of uncertainty from which a note says that the response is a guess


@dataclass(frozen=True)
class ResponseSelection:
    """The chosen response, by which score, and every candidate's scores, best first.

    uncertainty: stops; by how much curves that explain the photos as well differ from the chosen one: the root mean
    square over codes 10 to 245 and over the posterior, after one scale for each curve. For a camera's own JPEGs, the
    curves are those of measured cameras, and edges do not count. NaN by "paper".
    """

    response: Response
    method: str
    edge_count: int
    scores: tuple[ResponseScore, ...]
    uncertainty: float

    @property
    def note(self) -> str | None:
        """A line that says how uncertain the response is; None if it is sure, or if it is not known."""
        if not self.uncertainty > UNSURE:
            return None
        return (
            f"the response {self.response.name} is a guess: curves that explain the photos as well differ from it by "
            f"{self.uncertainty:.1f} stops between dark and bright; use RAW photos, measure it with "
            "`sehdr-warp calibrate`, or name it with --response"
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
            of one camera, taken one by one. Resampling in encoded values mixes colors, which shows at edges.
        candidates: by default the responses with a formula.
        method: "posterior" judges edges (Lin et al. 2004), clipped pixels, the spread and smoothness of light, and
            a prior; it needs none of them. Without `candidates`, and for photos that are not a camera's own, a smooth
            family of cameras' curves stands beside the formulae: a formula with a fifth of the posterior is taken;
            else the posterior's mean of log exposure at each code, a table beside the candidates.
            "paper" is SeHDR, section 3.3: the curve that does best on one photo "by dynamic range and smoothness"; the
            paper gives no formula, ours is ResponseScore.paper_score.
        from_camera: the photos are a camera's own JPEGs: nearly always `camera` or `rec709`, by their prior.
        seed: of the sample of edges where there are more than 4000.

    Raises:
        SehdrError: for another method, no candidates, an image of another shape or not finite, or, by "paper", fewer
            than 100 pixels that are neither black nor clipped.
    """
    if method not in ("posterior", "paper"):
        raise SehdrError(f"select_response: method = {method!r} is neither posterior nor paper")
    by_default = candidates is None and method == "posterior"
    with_family = by_default and not from_camera
    candidates = [analytic_response(name) for name in DESCRIPTIONS] if candidates is None else candidates
    if not candidates:
        raise SehdrError("select_response: there are no candidates; give at least one response")

    evidence = collect_evidence([image] if isinstance(image, np.ndarray) else image, seed)
    if method == "paper" and evidence.clear_pixels < 100:
        raise SehdrError("select_response: under 100 pixels are neither black nor clipped; name a response instead")

    curves = tabulate(candidates)
    if with_family:
        curves = curves.join(family_curves())
    likely = likelihoods(evidence, curves)
    scores = score_candidates(candidates, evidence, curves, likely, from_camera=from_camera)

    priors, posteriors = (np.array([getattr(score, name) for score in scores]) for name in ("prior", "posterior"))
    ranking = [-score.paper_score for score in scores] if method == "paper" else posteriors
    order = np.argsort(ranking, kind="stable")
    best, costs, logs = candidates[order[0]], posteriors, curves.at_codes
    if with_family:
        count = len(candidates)
        formula_costs = posteriors + np.log(np.exp(-priors).sum() / (1 - NO_FORMULA))
        family_costs = likely.total(len(evidence.edges))[count:] + np.log((len(logs) - count) / NO_FORMULA)
        costs = np.concatenate([formula_costs, family_costs])
    elif by_default:  # Edges of a camera's own JPEGs are sharpened: they would make the family sure of a wrong curve.
        logs = family_curves().at_codes
        costs = likelihoods(replace(evidence, edges=evidence.edges[:0]), family_curves()).total(0)
    chances = np.exp(costs.min() - costs)
    chances /= chances.sum()
    takes_mean = with_family and chances[order[0]] < DECISIVE
    if takes_mean:
        best = TabulatedResponse("posterior mean", np.r_[0.0, np.exp(chances @ logs)[1:]], CODES)
    off = (logs - np.log(np.maximum(np.asarray(best.decode(CODES)), 1e-30)))[:, 10:246] / np.log(2)
    width = math.sqrt(chances @ off.var(1))
    uncertainty = width if method == "posterior" else math.nan
    return ResponseSelection(best, method, len(evidence.edges), tuple(scores[index] for index in order), uncertainty)
