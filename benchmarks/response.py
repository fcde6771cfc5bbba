"""`python -m benchmarks response`: choose the response from rendered photos through known curves, and compare."""

import contextlib
import logging
from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.evaluation.metrics import decibels, mu_law
from sehdr_warp.evaluation.protocols import fit_scale
from sehdr_warp.response import Response, response_by_name
from sehdr_warp.response.selection import select_response
from sehdr_warp.scene import load_scene
from sehdr_warp.synth.expose import expose, exposure_ladder

from .results import new_result

LOG = logging.getLogger(__name__)
CODES = np.arange(10, 246)
FIXED = ("srgb", "camera")  # Curves that are also taken always, without a look at the photos
GOOD = 0.35  # Stops: a chosen curve within them counts as good


def response_error(response: Response, truth: Response) -> float:
    """Return the RMS over codes 10 to 245 of log2(decoded / true exposure), in stops, after the best scale."""
    return float(np.std(np.log2(response.decode(CODES / 255.0)) - np.log2(truth.decode(CODES / 255.0))))


def bench_response(
    data: Sequence[str], curves: Sequence[str], *, exposures: int = 5, max_size: int | None = None
) -> dict:
    """Expose scenes with HDR truth by each curve at a ladder of exposures, choose responses, and return the result.

    `trials` are single, `rows` the means by curve and method, and over all. Decibels are mu-law PSNR of the decoded
    photos, aligned; no 3D is involved.
    """
    settings = {"data": list(data), "curves": list(curves), "exposures": exposures, "max_size": max_size}
    result = new_result("response", torch.device("cpu"), settings)
    trials = result["trials"] = []
    scenes = [load_scene(place, max_size=max_size, response="srgb") for place in data]
    for scene, curve in product(scenes, curves):
        truth = response_by_name(curve)
        for index, time in enumerate(exposure_ladder(scene, truth, exposures)):
            views = expose(scene, truth, time).train_views
            psnr_of_truth = _decoded_psnr(views, truth, time)
            for method, choice in _choices([view.codes for view in views]):
                trial = {"scene": scene.name, "curve": curve, "exposure": index, "method": method}
                trial |= {"chosen": choice.name, "stops": response_error(choice, truth), "aligned_known": psnr_of_truth}
                trials.append(trial | {"aligned": _decoded_psnr(views, choice, time)})
        LOG.info("%s: exposed by %s", scene.name, curve)
    for curve, method in product((*curves, "all"), dict.fromkeys(trial["method"] for trial in trials)):
        fits = [t for t in trials if t["method"] == method and curve in (t["curve"], "all")]
        stops, *psnr = ([trial[key] for trial in fits] for key in ("stops", "aligned", "aligned_known"))
        row = {"curve": curve, "method": method, "trials": len(fits), "mean": float(np.mean(stops))}
        row |= {"worst": max(stops), "good": sum(error < GOOD for error in stops)}
        result["rows"].append(row | {"aligned": float(np.mean(psnr[0])), "aligned_known": float(np.mean(psnr[1]))})
    return result


def _choices(images) -> Iterator[tuple[str, Response]]:
    for name in FIXED:
        yield f"always {name}", response_by_name(name)
    # Photos that are black or white all over say nothing: only what is taken always is judged on them.
    with contextlib.suppress(SehdrError):
        selection = select_response(images, method="posterior", from_camera=False)
        yield "posterior", selection.response
        yield "paper", max(selection.scores, key=lambda score: score.paper_score).response


def _decoded_psnr(views, response: Response, time: float) -> float:
    truths = [torch.from_numpy(view.hdr).double() for view in views]
    photos = [torch.from_numpy(view.image) for view in views]
    decoded = [torch.from_numpy(np.asarray(response.decode(photo.double().numpy()) / time)) for photo in photos]
    scale = fit_scale((a, b, None, photo) for a, b, photo in zip(decoded, truths, photos, strict=True)) or 1.0
    largest = max(float(truth.max()) for truth in truths)
    pairs = zip(decoded, truths, strict=True)
    errors = [(mu_law((a * scale / largest).clamp(0, 1)) - mu_law(b / largest)).square().mean() for a, b in pairs]
    return decibels(float(torch.stack(errors).mean()))
