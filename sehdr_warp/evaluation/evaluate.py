"""Held-out evaluation of a trained run: every figure with its protocol's name, or null with a reason."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

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
    progress: Callable[[str], None] | None = None,
) -> dict:
    """Render the scene's test views with a trained run and compare them with the photos and the HDR truth.

    run: a sehdr_warp.training.Run, or anything with its `render(camera)` (an object with `.hdr`, [H, W, 3] scene-linear
        radiance on `device`), `render_ldr(camera, seconds)` ([H, W, 3] in [0, 1]), and the numbers `train_seconds`,
        `gaussian_count` and `iterations`; where it has them, `render_confidence(camera)` ([H, W] in [0, 1], or None)
        and `response` tell how well its confidence ranks its errors.
    scene: the views, at the exposure that was trained on. Without test views the training views are taken, and
        "split" says so.
    lpips_weights: folder, see load_lpips; protocols: names out of PROTOCOLS.
    peak_luminance, white_percentile: how PU21 maps the truth to cd/m^2, see pu21_metrics.
    flip: also HDR-FLIP, under each protocol's scale, where flip-evaluator is installed; slow.
    progress: called with one line for each view.

    Returns plain values, ready for strict JSON (null in place of NaN and infinity):
        "protocol": {name: {"psnr_mu", "ssim_mu", "lpips_mu", "views"}}, with "hdr_flip" if it was asked for; "aligned"
            also holds its "scale"
        "pu21": {name: {"psnr", "ssim"}, "peak_luminance", "white_percentile"}
        "ldr": {"psnr", "ssim", "lpips"} of the simulated photo at the view's exposure time, unquantised, against the
            photo
        "regions": {region: {"fraction", "psnr_ldr", "psnr_mu": {name: dB}}}, errors pooled over all views
        "confidence": {"spearman_log2", "spearman_mu": rank correlation of 1 - confidence with the error; "mean",
            "pixels", "scale"}, see ranking.py
        "views": the same for each view; and "split", "lpips_backbone", "train_seconds", "gaussians", "iterations"
    Means are over views. What cannot be computed is null with "reason" (or "lpips_reason") beside it. A view's mask
    applies to everything: outside it the prediction is taken to be right, and nothing there is averaged, but by LPIPS
    and HDR-FLIP, which are of whole images; a view whose mask is empty is left out.

    Raises SehdrError for a scene without views, images that disagree with their camera, a render that is not finite
    or an unknown protocol; InputError for LPIPS weights that cannot be read.
    """
    evaluation = _Evaluation(run, scene, lpips_weights, protocols, peak_luminance, white_percentile, flip)
    return evaluation.result(progress)


class _Evaluation:
    def __init__(self, run, scene, lpips_weights, names, peak_luminance, white_percentile, flip):
        for name in names:
            if name not in PROTOCOLS:
                raise SehdrError(f"protocol = {name!r} is unknown; choose from {', '.join(PROTOCOLS)}")
        self.run, self.scene, self.names = run, scene, tuple(names)
        self.pu21_mapping = {"peak_luminance": peak_luminance, "white_percentile": white_percentile}
        self.split = "test" if scene.test_views else "train"
        self.views = [view for view in scene.test_views or scene.train_views if view.mask is None or view.mask.any()]
        if not self.views:
            raise SehdrError(f"scene {scene.name!r} has no views to evaluate; check its splits and masks")
        self.device = torch.device(run.device)
        self.lpips, self.lpips_reason = load_lpips(lpips_weights, self.device)
        self.with_flip = flip
        self.flip, self.flip_reason = load_flip() if flip else (None, None)
        self.regions = {region: _RegionErrors(self.names) for region in metrics.REGIONS}
        self.ranking = ErrorRanking()

    def result(self, progress) -> dict:
        scale, scale_reason = self._scale(progress)
        rows = []
        for number, view in enumerate(self.views, 1):
            rows.append(self._view(view, scale))
            if progress:
                progress(_line(number, len(self.views), rows[-1]))
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
            "train_seconds": self.run.train_seconds,
            "gaussians": self.run.gaussian_count,
            "iterations": self.run.iterations,
        }
        return _plain(result)

    def _scale(self, progress) -> tuple[float | None, str | None]:
        """The one factor of the scene for `aligned`, or why there is none."""
        if "aligned" not in self.names or not any(view.hdr is not None for view in self.views):
            return None, None
        views = [view for view in self.scene.train_views if view.hdr is not None]
        if not views:
            return None, "no training view holds HDR truth to fit the scale on"
        if progress:
            progress(f"fitting the scale on {len(views)} training views")
        scale = fit_scale((*self._render(view), self._tensor(view.mask), self._tensor(view.image)) for view in views)
        return scale, None if scale else "the renders of the training views hold no light to fit the scale on"

    def _render(self, view: View) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Prediction and truth, [H, W, 3] float32 on the run's device each; no truth gives None."""
        size = (view.camera.height, view.camera.width, 3)
        for what, image in (("photo", view.image), ("HDR truth", view.hdr)):
            if image is not None and image.shape != size:
                raise SehdrError(
                    f"view {view.name!r}: its {what} is {image.shape[1]} x {image.shape[0]}, its camera "
                    f"{size[1]} x {size[0]}; load both at one size"
                )
        prediction = self.run.render(view.camera).hdr.detach()
        if not bool(torch.isfinite(prediction).all()):
            raise SehdrError(f"view {view.name!r}: the render holds values that are not finite; the training diverged")
        return prediction.float(), self._tensor(view.hdr)

    def _tensor(self, array) -> torch.Tensor | None:
        return None if array is None else torch.tensor(array, dtype=torch.float32, device=self.device)

    def _view(self, view: View, scale: float | None) -> dict:
        hdr, truth = self._render(view)
        photo, mask = self._tensor(view.image), self._tensor(view.mask)
        encoded = self.run.render_ldr(view.camera, view.exposure_time).detach().float()
        encoded = _inside(encoded, photo, mask)
        row = {"name": view.name, "ldr": self._ldr(encoded, photo, mask), "protocol": {}, "pu21": {}}
        regions = metrics.region_masks(photo)
        weights = {name: region if mask is None else region * mask for name, region in regions.items()}
        counted = float(photo.shape[0] * photo.shape[1] if mask is None else mask.sum())
        for region, weight in weights.items():
            self.regions[region].add_ldr(encoded, photo, weight, counted)
        if truth is None:
            return row
        self._rank(view, hdr, truth, regions["well-exposed"], mask)
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

    def _rank(self, view: View, prediction, truth, well_exposed, mask) -> None:
        """Sets the confidence of a view beside its errors, if the run knows its confidence."""
        render = getattr(self.run, "render_confidence", None)
        confidence = render(view.camera) if render else None
        if confidence is not None:
            black = self.run.response.decode(truth.new_full((1, 3), DARKEST_CODE))
            darkest = float(black.mean()) / view.exposure_time
            self.ranking.add(confidence, prediction, truth, well_exposed, darkest, mask)

    def _ldr(self, encoded, photo, mask) -> dict:
        return {
            "psnr": metrics.psnr(encoded, photo, mask),
            "ssim": metrics.ssim(encoded, photo, mask),
            "lpips": self._lpips(encoded, photo),
        }

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
        error, total = metrics.squared_error(prediction, truth, weight)
        self.pixels += counted
        self.weight += total
        self.ldr += float(error.mean())

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
    hdr = "".join(f", HDR {name} {figures['psnr_mu']:.2f} dB" for name, figures in row["protocol"].items())
    return f"view {number}/{count} {row['name']}: LDR {row['ldr']['psnr']:.2f} dB{hdr}"
