"""Held-out evaluation of a trained run: every figure with its protocol's name, or null with a reason."""

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import torch

from ..errors import SehdrError
from ..scene import Scene, View
from . import metrics
from .flip import load_flip
from .lpips import BACKBONE, SMALLEST_EDGE, load_lpips
from .protocols import PROTOCOLS, fit_scale, normalise, tone_map, tone_mapped_psnr
from .ranking import DARKEST_CODE, ErrorRanking

# cd/m^2 at which the brightest value of a view's truth is shown for PU21: the peak of a common HDR display.
PEAK_LUMINANCE = 1000.0
PERFECT = "there is no error at all, so the PSNR is infinite"
log = logging.getLogger(__name__)


class Pictures(Protocol):
    """Predictions of views. facts: plain values about them, for the result."""

    facts: dict

    def hdr(self, view: View) -> torch.Tensor:
        """[H, W, 3] scene-linear radiance."""

    def ldr(self, view: View) -> torch.Tensor | None:
        """[H, W, 3] simulated photo in [0, 1], or None where there is none."""

    def doubt(self, view: View) -> tuple[torch.Tensor, float] | None:
        """Confidence [H, W] in [0, 1], and the radiance that a photo shows as black; None where it is not known."""


class RunPictures:
    """What a trained run renders."""

    def __init__(self, run):
        self.run = run
        names = {"train_seconds": "train_seconds", "gaussians": "gaussian_count", "iterations": "iterations"}
        self.facts = {key: getattr(run, name) for key, name in names.items()}

    def hdr(self, view):
        return self.run.render(view.camera).hdr

    def ldr(self, view):
        return self.run.render_ldr(view.camera, view.exposure_time)

    def doubt(self, view):
        render = getattr(self.run, "render_confidence", None)
        confidence = render(view.camera) if render else None
        if confidence is None:
            return None
        black = self.run.response.decode(torch.full((1, 3), DARKEST_CODE, device=confidence.device))
        return confidence, float(black.mean()) / view.exposure_time


@torch.no_grad()
def evaluate(
    run,
    scene: Scene,
    *,
    lpips_weights: Path | str | None = None,
    protocols: Sequence[str] = PROTOCOLS,
    peak_luminance: float = PEAK_LUMINANCE,
    white_percentile: float = 100.0,
    flip: bool = False,
) -> dict:
    """Render the scene's test views with a trained run and compare them with the photos and the HDR truth.

    Args:
        run: a Run.
        scene: the views, at the exposure that was trained on. Without test views the training views are taken, and
            "split" says so.
        lpips_weights: a folder, see load_lpips.
        protocols: names out of PROTOCOLS.
        peak_luminance, white_percentile: how PU21 maps the truth to cd/m^2, see pu21_metrics.
        flip: also HDR-FLIP under each protocol's scale, where flip-evaluator is installed; slow.

    Returns:
        Plain values, ready for strict JSON (null in place of NaN and infinity). "protocol": {name: psnr_mu, ssim_mu,
        lpips_mu, views, hdr_flip if asked for}, with "scale" for "aligned"; "pu21": {name: psnr, ssim}; "ldr": psnr,
        ssim, lpips of the simulated photo, unquantised; "regions": {region: fraction, psnr_ldr, psnr_mu}, pooled over
        views; "confidence": see ranking.py; "views": the same for each view; "split", "lpips_backbone" and the run's
        facts. Means are over views. What cannot be computed is null with "reason" (or "lpips_reason") beside it.
        Outside a view's mask the prediction counts as right and nothing is averaged, but by LPIPS and HDR-FLIP, which
        are of whole images; views with an empty mask are left out.

    Raises:
        SehdrError: for a scene without views, images that disagree with their camera, a render that is not finite or an
            unknown protocol.
        InputError: for LPIPS weights that cannot be read.
    """
    options = {"peak_luminance": peak_luminance, "white_percentile": white_percentile}
    return Evaluation(RunPictures(run), scene, run.device, lpips_weights, protocols, options, flip).result()


class Evaluation:
    """One comparison of pictures with a scene's views."""

    def __init__(self, pictures: Pictures, scene, device, lpips_weights, names, pu21_mapping, flip, views=None):
        for name in names:
            if name not in PROTOCOLS:
                raise SehdrError(f"protocol = {name!r} is unknown; choose from {', '.join(PROTOCOLS)}")
        self.pictures, self.scene, self.names = pictures, scene, tuple(names)
        self.pu21_mapping, self.split = pu21_mapping, "test" if scene.test_views else "train"
        given = (scene.test_views or scene.train_views) if views is None else views
        self.views = [view for view in given if view.mask is None or view.mask.any()]
        self.scale_views = scene.train_views
        if not self.views:
            raise SehdrError(f"scene {scene.name!r} has no views to evaluate; check its splits and masks")
        self.device = torch.device(device)
        self.lpips, self.lpips_reason = load_lpips(lpips_weights, self.device)
        self.with_flip = flip
        self.flip, self.flip_reason = load_flip() if flip else (None, None)
        self.regions = {region: _RegionErrors(self.names) for region in metrics.REGIONS}
        self.ranking = ErrorRanking()

    def result(self) -> dict:
        """The figures, as evaluate() describes them."""
        scale, scale_reason = self._scale()
        rows = []
        for number, view in enumerate(self.views, 1):
            rows.append(self._view(view, scale))
            log.info(_line(number, len(self.views), rows[-1]))
        truths = [row for row, view in zip(rows, self.views) if view.hdr is not None]
        missing = None if truths else f"the {self.split} views hold no HDR truth"
        hdr, pu21 = {}, {}
        for name in self.names:
            reason = missing or (scale_reason if name == "aligned" else None)
            if reason:
                hdr[name] = {"psnr_mu": None, "ssim_mu": None, "lpips_mu": None, "views": 0, "reason": reason}
                hdr[name] |= {"hdr_flip": None} if self.with_flip else {}
                pu21[name] = {"psnr": None, "ssim": None, "reason": reason}
                continue
            hdr[name] = _mean([row["protocol"][name] for row in truths]) | {"views": len(truths)}
            pu21[name] = _mean([row["pu21"][name] for row in truths])
            self._explain(hdr[name], "lpips_mu")
            hdr[name] |= {"flip_reason": self.flip_reason} if self.flip_reason else {}
        if "aligned" in hdr:
            hdr["aligned"]["scale"] = scale
        ldr = _mean([row["ldr"] for row in rows])
        if ldr["psnr"] is None:
            ldr["reason"] = "the folder holds radiance, no simulated photos"
        else:
            self._explain(ldr, "lpips")
        result = {
            "scene": self.scene.name,
            "split": self.split,
            "protocol": hdr,
            "pu21": pu21 | self.pu21_mapping,
            "ldr": ldr,
            "regions": {region: errors.result(missing) for region, errors in self.regions.items()},
            "confidence": self.ranking.result() | ({"reason": missing} if missing else {}),
            "views": rows,
            "lpips_backbone": BACKBONE if self.lpips else None,
        }
        return _plain(result | self.pictures.facts)

    def _scale(self) -> tuple[float | None, str | None]:
        """The one factor of the scene for `aligned`, or why there is none."""
        if "aligned" not in self.names or not any(view.hdr is not None for view in self.views):
            return None, None
        views = [view for view in self.scale_views if view.hdr is not None]
        if not views:
            return None, "no training view holds HDR truth to fit the scale on"
        log.info("fitting the scale on %d views", len(views))
        scale = fit_scale((*self._render(view), self._tensor(view.mask), self._tensor(view.image)) for view in views)
        return scale, None if scale else "the pictures hold no light to fit the scale on"

    def _render(self, view: View) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Prediction and truth, [H, W, 3] float32 on the device each; no truth gives None."""
        size = (view.camera.height, view.camera.width, 3)
        prediction = self.pictures.hdr(view).detach()
        for what, image in (("photo", view.codes), ("HDR truth", view.hdr), ("picture", prediction)):
            if image is not None and tuple(image.shape) != size:
                raise SehdrError(
                    f"view {view.name!r}: its {what} is {image.shape[1]} x {image.shape[0]}, its camera "
                    f"{size[1]} x {size[0]}; take both at one size"
                )
        if not bool(torch.isfinite(prediction).all()):
            raise SehdrError(f"view {view.name!r}: the render holds values that are not finite; the training diverged")
        return prediction.float(), self._tensor(view.hdr)

    def _tensor(self, array) -> torch.Tensor | None:
        return None if array is None else torch.tensor(array, dtype=torch.float32, device=self.device)

    def _view(self, view: View, scale: float | None) -> dict:
        hdr, truth = self._render(view)
        photo, mask = self._tensor(view.image), self._tensor(view.mask)
        row = {"name": view.name, "ldr": dict.fromkeys(("psnr", "ssim", "lpips")), "protocol": {}, "pu21": {}}
        regions = metrics.region_masks(photo)
        weights = {name: region if mask is None else region * mask for name, region in regions.items()}
        counted = float(photo.shape[0] * photo.shape[1] if mask is None else mask.sum())
        encoded = self.pictures.ldr(view)
        if encoded is not None:
            encoded = _inside(encoded.detach().float(), photo, mask)
            figures = {"psnr": metrics.psnr(encoded, photo, mask), "ssim": metrics.ssim(encoded, photo, mask)}
            row["ldr"] = figures | {"lpips": self._lpips(encoded, photo)}
        for region, weight in weights.items():
            self.regions[region].add_ldr(encoded, photo, weight, counted)
        if truth is None:
            return row
        if doubt := self.pictures.doubt(view):
            self.ranking.add(doubt[0], hdr, truth, regions["well-exposed"], doubt[1], mask)
        for name in self.names:
            if name == "aligned" and scale is None:
                continue
            factor = scale if name == "aligned" else 1.0
            pair = tone_map(name, hdr, truth, mask, scale=factor)
            pair = (_inside(pair[0], pair[1], mask), pair[1])
            row["protocol"][name] = {
                "psnr_mu": tone_mapped_psnr(name, *pair, mask),
                "ssim_mu": metrics.ssim(*pair, mask),
                "lpips_mu": self._lpips(*pair),
            }
            linear = normalise(name, hdr, truth, mask, scale=factor)
            linear = (_inside(linear[0], linear[1], mask), linear[1])
            row["pu21"][name] = metrics.pu21_metrics(*linear, mask, **self.pu21_mapping)
            if self.with_flip:
                row["protocol"][name]["hdr_flip"] = self.flip(*linear) if self.flip else None
            for region, weight in weights.items():
                self.regions[region].add_hdr(name, *pair, weight)
        return row

    def _lpips(self, prediction, truth) -> float | None:
        if self.lpips is None or min(truth.shape[:2]) < SMALLEST_EDGE:
            return None
        return self.lpips(prediction, truth)

    def _explain(self, figures: dict, key: str) -> None:
        """Say beside a missing LPIPS why it is missing."""
        if figures[key] is None:
            small = f"a view is smaller than {SMALLEST_EDGE} pixels"
            figures["lpips_reason"] = self.lpips_reason or small


class _RegionErrors:
    """Squared errors of one region, pooled over views: a view may have few of its pixels, or none."""

    def __init__(self, names):
        self.pixels = self.weight = self.ldr = 0.0
        self.hdr = dict.fromkeys(names, (0.0, 0.0))

    def add_ldr(self, prediction, truth, weight, counted: float) -> None:
        """Counts the region; prediction None leaves its photo error unknown."""
        error, total = metrics.squared_error(truth if prediction is None else prediction, truth, weight)
        self.pixels += counted
        self.weight += total
        self.ldr += math.nan if prediction is None else float(error.mean())

    def add_hdr(self, name, prediction, truth, weight) -> None:
        error, total = metrics.squared_error(prediction, truth, weight)
        before = self.hdr[name]
        self.hdr[name] = (before[0] + float(error.mean()), before[1] + total)

    def result(self, missing: str | None) -> dict:
        figures = {
            "fraction": self.weight / self.pixels,
            "psnr_ldr": metrics.decibels(self.ldr / self.weight if self.weight else math.nan),
            "psnr_mu": {
                name: metrics.decibels(error / weight if weight else math.nan)
                for name, (error, weight) in self.hdr.items()
            },
        }
        if not self.weight:
            figures["reason"] = "no pixel of the photos lies in this region"
        elif missing:
            figures["reason"] = missing
        return figures


def _inside(prediction: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """The prediction where the mask counts, the truth elsewhere: windows that cross the border then see no error."""
    return prediction if mask is None else torch.lerp(truth, prediction, mask[..., None].to(truth))


def _mean(rows: list[dict]) -> dict:
    """The mean of each figure over views; None where some view lacks it."""
    return {
        key: None if any(row[key] is None for row in rows) else math.fsum(row[key] for row in rows) / len(rows)
        for key in rows[0]
    }


def _plain(value):
    """The same tree without NaN and infinity, which JSON does not know; an infinite PSNR gets a reason beside it."""
    if isinstance(value, dict):
        perfect = any(key.startswith("psnr") and math.inf in _values(item) for key, item in value.items())
        reason = {"reason": PERFECT} if perfect and "reason" not in value else {}
        return {key: _plain(item) for key, item in value.items()} | reason
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _values(item) -> list:
    return list(item.values()) if isinstance(item, dict) else [item]


def _line(number: int, count: int, row: dict) -> str:
    figures = [] if row["ldr"]["psnr"] is None else [f"LDR {row['ldr']['psnr']:.2f} dB"]
    figures += [f"HDR {name} {values['psnr_mu']:.2f} dB" for name, values in row["protocol"].items()]
    return f"view {number}/{count} {row['name']}: {', '.join(figures)}"
