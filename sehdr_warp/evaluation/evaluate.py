"""Held-out evaluation of a trained run: every figure has its protocol's name, or is None with a reason."""

import logging
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import SehdrError, require_loaded, require_trained
from ..runs.run import Run
from ..runs.scene_description import warn_of_other_cameras
from ..scene import Scene, View
from . import metrics
from .lights import LightRegion, count_lights, light_regions
from .perceptual import BACKBONE, SMALLEST_EDGE, load_lpips
from .protocols import PROTOCOLS, fit_scale, normalize, tone_map, tone_mapped_psnr
from .ranking import DARKEST_CODE, ErrorRanking

PEAK_LUMINANCE = 1000.0
"""cd/m^2 at which PU21 shows the brightest value of a view's truth: the peak of a common HDR display."""
HDR_FIGURES = ("psnr_mu", "ssim_mu", "lpips_mu")
INFINITE_PSNR = "there is no error at all, so the PSNR is infinite"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Predictions:
    """Predictions for the views of a scene."""

    hdr: Callable[[View], Tensor]  # Returns the radiance of a view, [H, W, 3]
    facts: dict[str, Any]  # Plain values for the result
    ldr: Callable[[View], Tensor | None] = lambda view: None  # Simulated photo of a view, [H, W, 3] in [0, 1], or None
    confidence: Callable[[View], Tensor | None] = lambda view: None  # Its reliability [H, W] in [0, 1], or None
    black: float = 0.0  # Largest exposure that photos show as black; matters if there is a confidence


def _run_predictions(run: Run) -> Predictions:
    """Return the predictions of a trained run."""
    return Predictions(
        hdr=lambda view: run.render(view.camera).hdr,
        facts={"train_seconds": run.train_seconds, "gaussians": run.gaussian_count, "iterations": run.iterations},
        ldr=lambda view: run.render_ldr(view.camera, view.exposure_time),
        confidence=lambda view: run.render_confidence(view.camera),
        black=float(run.response.decode(torch.full((1, 3), DARKEST_CODE, device=run.device)).mean()),
    )


@torch.no_grad()
def evaluate(run: Run, scene: Scene, *, lpips_weights: Path | str | None = None) -> dict[str, Any]:
    """Render the scene's test views with a trained run and compare them with the photos and the HDR truth.

    Args:
        run: a trained run.
        scene: at the exposure that was trained on. Without test views the training views are taken; "split" says so.
        lpips_weights: a folder, see load_lpips.

    Returns:
        Plain values, ready for strict JSON. "protocol": {name: psnr_mu, ssim_mu, lpips_mu, views}, with "scale" for
        "aligned"; "pu21": {name: psnr, ssim}; "ldr": psnr, ssim, lpips of the simulated photo, unquantised; "regions":
        {region: fraction, psnr_ldr, psnr_mu}, pooled over views; "lights": see count_lights();
        "confidence": see ranking.py; "views": the same for each view; "split", "lpips_backbone" and the run's facts.
        A figure that cannot be computed is None with "reason" (or "lpips_reason") beside it. Pixels outside a view's
        mask are not averaged, except by LPIPS, for which the prediction equals the truth there; views with an empty
        mask are left out.

    Raises:
        SehdrError: for a scene without views, images that disagree with their camera or a render that is not finite.
        InputError: for LPIPS weights that cannot be read.
    """
    require_loaded("load_scene", scene)
    require_trained(run)
    warn_of_other_cameras(run, scene)
    return Evaluation(_run_predictions(run), run.normalize_photos(scene), run.device, lpips_weights).result()


class Evaluation:
    """Compares predictions with the views of a scene."""

    def __init__(
        self,
        predictions: Predictions,
        scene: Scene,
        device: torch.device | str,
        lpips_weights: Path | str | None,
        views: Sequence[View] = (),
        scale_views: Sequence[View] = (),
    ):
        """Choose the views.

        Args:
            predictions: what is compared.
            scene: its photos and truth.
            device: where the figures are computed.
            lpips_weights: a folder, see load_lpips; None for the one of SEHDR_LPIPS.
            views: what is compared; by default the test views, or the training views if there are none.
            scale_views: views to fit the scale of "aligned" on; by default the training views.
        """
        self.predictions, self.scene, self.device = predictions, scene, torch.device(device)
        self.split = "test" if scene.test_views else "train"
        candidates = views or scene.test_views or scene.train_views
        self.views = [view for view in candidates if view.mask is None or view.mask.any()]
        if not self.views:
            raise SehdrError(f"scene {scene.name!r} has no views to evaluate; check its splits and masks")
        self.scale_views = [view for view in scale_views or scene.train_views if view.hdr is not None]
        self.lpips, self.lpips_reason = load_lpips(lpips_weights, self.device)
        # By region and figure: the weighted squared error and the weight, summed over views because a view may have no
        # pixel of a region. Under "share": the pixels of the region, and all pixels.
        self.sums: dict[tuple[str, str], np.ndarray] = defaultdict(lambda: np.zeros(2))
        self.ranking = ErrorRanking()
        self.lights: list[LightRegion] = []

    def result(self) -> dict:
        """Return the figures that evaluate() describes."""
        kind = "training" if self.split == "train" else self.split
        missing = None if any(view.hdr is not None for view in self.views) else f"the {kind} views hold no HDR truth"
        scale, scale_reason = (None, missing) if missing else self._scale()
        rows = []
        for number, view in enumerate(self.views, 1):
            rows.append(self._view(view, scale))
            psnr = {"LDR": rows[-1]["ldr"]["psnr"]}
            psnr |= {f"HDR {name}": figures["psnr_mu"] for name, figures in rows[-1]["protocol"].items()}
            figures = ", ".join(f"{name} {value:.2f} dB" for name, value in psnr.items() if value is not None)
            log.info("view %d/%d %s: %s", number, len(self.views), view.name, figures)
        hdr, pu21 = {}, {}
        for name in PROTOCOLS:
            reason = scale_reason if name == "aligned" else missing
            missing_reason = {"reason": reason} if reason else {}
            with_truth = [row for row in rows if name in row["protocol"]]
            figures = _mean([row["protocol"][name] for row in with_truth], *HDR_FIGURES)
            hdr[name] = figures | {"views": len(with_truth)} | (missing_reason or self._lpips_reason(figures))
            pu21[name] = _mean([row["pu21"][name] for row in with_truth], "psnr", "ssim") | missing_reason
        hdr["aligned"]["scale"] = scale
        ldr = _mean([row["ldr"] for row in rows], "psnr", "ssim", "lpips")
        without_photos = {"reason": "the folder holds radiance, no simulated photos"}
        ldr |= without_photos if ldr["psnr"] is None else self._lpips_reason(ldr)
        no_lights = dict.fromkeys(("count", "lost", "energies")) | {"reason": missing}
        result = {
            "scene": self.scene.name,
            "split": self.split,
            "protocol": hdr,
            "pu21": pu21 | {"peak_luminance": PEAK_LUMINANCE},
            "ldr": ldr,
            "regions": {region: self._region(region, missing) for region in metrics.REGIONS},
            "lights": no_lights if missing else count_lights(self.lights),
            "confidence": self.ranking.result() | ({"reason": missing} if missing else {}),
            "views": rows,
            "lpips_backbone": BACKBONE if self.lpips else None,
        }
        return _plain(result | self.predictions.facts)

    def _scale(self) -> tuple[float | None, str | None]:
        """Return the factor of "aligned", or None and the reason."""
        if not self.scale_views:
            return None, "no training view holds HDR truth to fit the scale on"
        log.info("fitting the scale on %d views", len(self.scale_views))
        scale = fit_scale(
            (*self._render(view), self._tensor(view.mask), self._tensor(view.image)) for view in self.scale_views
        )
        return (scale, None) if scale else (None, "the predictions hold no light to fit the scale on")

    def _render(self, view: View) -> tuple[Tensor, Any]:
        """Return prediction and truth, [H, W, 3] float32 on the device each; the truth may be None."""
        prediction = self.predictions.hdr(view).detach()
        if tuple(prediction.shape) != view.codes.shape:
            (height, width), (photo_height, photo_width) = prediction.shape[:2], view.codes.shape[:2]
            sizes = f"its picture is {width} x {height}, its photo {photo_width} x {photo_height}"
            remedy = "take both at one size" + ": --max-size reduces the truth" * (width < photo_width)
            raise SehdrError(f"view {view.name!r}: {sizes}; {remedy}")
        if not bool(torch.isfinite(prediction).all()):
            raise SehdrError(f"view {view.name!r}: the render holds values that are not finite; the training diverged")
        return prediction.float(), self._tensor(view.hdr)

    def _tensor(self, array) -> Any:
        return None if array is None else torch.tensor(array, dtype=torch.float32, device=self.device)

    def _view(self, view: View, scale: float | None) -> dict:
        """Return the figures of one view, and add it to the regions, the lights and the ranking."""
        hdr, truth = self._render(view)
        photo, mask = self._tensor(view.image), self._tensor(view.mask)
        ldr, protocol, pu21 = dict.fromkeys(("psnr", "ssim", "lpips")), {}, {}
        regions, compared = metrics.region_masks(photo), []
        if (encoded := self.predictions.ldr(view)) is not None:
            pair = _inside((encoded.detach().float(), photo), mask)
            figures = metrics.psnr(*pair, mask), metrics.ssim(*pair, mask), self._lpips(*pair)
            ldr = dict(zip(ldr, figures, strict=True))
            compared.append(("ldr", *pair))
        if truth is not None and (confidence := self.predictions.confidence(view)) is not None:
            black = self.predictions.black / view.exposure_time
            self.ranking.add(confidence, hdr, truth, regions["well-exposed"], black, mask)
        if truth is not None and view.camera.is_pinhole:
            true_light, light = (image.mean(2).cpu().numpy() for image in (truth, hdr * (scale or 1.0)))
            self.lights += light_regions(true_light, light, view.camera, regions["clipped"].cpu().numpy())
        for name in PROTOCOLS:
            if truth is None or (name == "aligned" and scale is None):
                continue
            linear = normalize(name, hdr, truth, mask, scale=scale)
            pair, linear = _inside(tone_map(name, *linear), mask), _inside(linear, mask)
            figures = tone_mapped_psnr(name, *pair, mask), metrics.ssim(*pair, mask), self._lpips(*pair)
            protocol[name] = dict(zip(HDR_FIGURES, figures, strict=True))
            pu21[name] = metrics.pu21_metrics(*linear, mask, peak_luminance=PEAK_LUMINANCE)
            compared.append((name, *pair))
        for region, inside in regions.items():
            weight = inside if mask is None else inside * mask
            pixel_count = weight.numel() if mask is None else float(mask.sum())
            self.sums[region, "share"] += float(weight.sum()), pixel_count
            for name, prediction, goal in compared:
                error, total = metrics.squared_error(prediction, goal, weight)
                self.sums[region, name] += float(error.mean()), total
        return {"name": view.name, "ldr": ldr, "protocol": protocol, "pu21": pu21}

    def _region(self, region: str, missing: str | None) -> dict:
        """Return the figures of a region over all views; missing: why there is no truth, or None."""
        inside, pixel_count = self.sums[region, "share"]
        reason = missing if inside else "no pixel of the photos lies in this region"
        sums = {name: self.sums[region, name] for name in ("ldr", *PROTOCOLS)}
        psnr = {
            name: metrics.decibels(error / weight if weight else math.nan) for name, (error, weight) in sums.items()
        }
        figures = {"fraction": float(inside / pixel_count), "psnr_ldr": psnr.pop("ldr"), "psnr_mu": psnr}
        return figures | ({"reason": reason} if reason else {})

    def _lpips(self, prediction, truth) -> float | None:
        return self.lpips(prediction, truth) if self.lpips and min(truth.shape[:2]) >= SMALLEST_EDGE else None

    def _lpips_reason(self, figures: dict) -> dict:
        """Return {"lpips_reason": why LPIPS is missing}, or {} if it is there."""
        reason = self.lpips_reason or f"a view is smaller than {SMALLEST_EDGE} pixels"
        return {"lpips_reason": reason} if None in (figures.get("lpips", 0), figures.get("lpips_mu", 0)) else {}


def _inside(pair: tuple[Tensor, Tensor], mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return prediction and truth with the prediction set to the truth where the mask is 0.

    Windows across the border of the mask then contain no error from outside. What has a part of the weight, such as a
    pixel near the pole of a panorama, is weighed by PSNR and SSIM; LPIPS counts it fully.
    """
    prediction, truth = pair
    return (prediction if mask is None else torch.where(mask[..., None] > 0, prediction, truth)), truth


def _mean(rows: list[dict], *names: str) -> dict[str, float | None]:
    """Return the mean of each figure over views; None without views, or if a view lacks it."""
    lacking = {name for name in names if not rows or any(row[name] is None for row in rows)}
    return {name: None if name in lacking else math.fsum(row[name] for row in rows) / len(rows) for name in names}


def _plain(value) -> Any:
    """Return a tree of values with None for NaN and infinity, which JSON lacks; an infinite PSNR gets a reason."""
    if isinstance(value, dict):
        figures = [item for key, item in value.items() if key.startswith("psnr")]
        perfect = any(math.inf in (item.values() if isinstance(item, dict) else [item]) for item in figures)
        reason = {"reason": INFINITE_PSNR} if perfect and "reason" not in value else {}
        return {key: _plain(item) for key, item in value.items()} | reason
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
