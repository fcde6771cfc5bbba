"""`bench scale`: how time and memory of splats and training steps grow with Gaussians, pixels, channels and photos."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ..errors import SehdrError
from ..splatting.memory import held_by_warp
from ..training.config_files import load_config
from .gsplat_peer import BOUND, GSPLAT, gsplat_renderer, missing, rasterize_with_gsplat
from .kernels import OURS, compared, differs, image_and_gradients, render, render_reference
from .results import check, new_result
from .splats import Size, SplatScene, make_photo_scene, make_splat_scene
from .step import forget_peaks, held_memory, make_trainer, step_variant
from .timing import Variant, peak_memory, time_variants

LOG = logging.getLogger(__name__)
COMPARED_CHANNELS = 9
"""gsplat stands beside ours at this count."""
STEP_VIEWS, STEP_PRESET = 2, "paper"
"""The preset with three color sets, nine channels in one pass."""
STEP, SPLAT = "training step", "splat"
STEEPEST = 1.2
"""A slope above it, at the large end of a sweep, is steeper than linear; 2 is quadratic."""
LARGE_END = 3
"""The large end is a sweep's last so many points."""
COLUMNS = {
    "sweep": "", "Gaussians=gaussians": ",d", "width": "d", "height": "d", "C=channels": "d", "photos": "d",
    "rasterizer=implementation": "", "what": "", "median ms=median_ms": ".3f", "n=repetitions": "d",
    "peak MiB=peak_memory_bytes": "MiB",
}  # fmt: skip


@dataclass(frozen=True)
class Point:
    """Where a sweep measures. photos: of its training step; 0 for none."""

    size: Size
    channels: int = COMPARED_CHANNELS
    photos: int = STEP_VIEWS

    def varied(self, sweep: str) -> int:
        size = self.size
        return {"gaussians": size.gaussians, "pixels": size.width * size.height}.get(sweep) or getattr(self, sweep)


def sweeps(device_type: str, small: bool = False) -> dict[str, list[Point]]:
    """The points of each sweep, ascending. small: every second one, up to a moderate size."""
    if device_type == "cuda":
        counts = (10_000, 30_000, 100_000, 300_000, 1_000_000, 2_500_000, 5_000_000)
        sides = ((200, 200), (400, 400), (800, 800), (1600, 1200), (2560, 1440), (3840, 2160))
        channels, photos = (3, 4, 6, 9, 12, 16, 24, 32, 48), (2, 8, 32, 128)
        image, many, few = (1600, 1200), 200_000, Size(200_000, 800, 800)
    else:
        counts, sides = (1000, 2500, 5000, 10_000, 20_000, 50_000), ((64, 64), (128, 128), (256, 256), (512, 512))
        channels, photos = (3, 6, 9, 16, 24, 48), (2, 8, 32)
        image, many, few = (200, 200), 5000, Size(5000, 200, 200)
    found = {
        "gaussians": [Point(Size(count, *image)) for count in counts],
        "pixels": [Point(Size(many, *side)) for side in sides],
        "channels": [Point(few, count, 0) for count in channels],
        "photos": [Point(few, COMPARED_CHANNELS, count) for count in photos],
    }
    return {name: points[:-1:2] if small else points for name, points in found.items()}


def bench_scale(
    names: Sequence[str], device: torch.device, *, peers: bool, repetitions: int, budget: float, small: bool = False
) -> dict:
    """A result: a row for each splat and training step at each point, and `slopes` of their logarithms.

    Args:
        names: of sweeps(). peers: gsplat's splat, and the same step on its rasterizer, beside ours.
    """
    known = sweeps(device.type, small)
    for name in names:
        if name not in known:
            raise SehdrError(f"--sweeps {','.join(names)}: {name!r} is none; use {', '.join(known)}")
    settings = {"device": str(device), "sweeps": list(names), "repetitions": repetitions, "preset": STEP_PRESET}
    result = new_result("scale", device, settings)
    reason = missing(device) if peers else "gsplat not compared: not asked for (--peers)"
    result["notes"] += [reason] if reason else []
    for name in names:
        for point in known[name]:
            peer = reason is None and point.channels == COMPARED_CHANNELS
            rows = [] if name == "photos" else _splat_rows(point, device, peer, repetitions, budget, result["checks"])
            forget_peaks(device)
            if point.photos:
                rows += _step_rows(point, device, peer, repetitions, budget, result["checks"])
                forget_peaks(device)
            size = point.size
            place = {"sweep": name, "varied": point.varied(name), "gaussians": size.gaussians, "width": size.width}
            place |= {"height": size.height, "channels": point.channels, "photos": point.photos or None}
            result["rows"] += [place | row for row in rows]
            shown = (f"{row['what']} {row['median_ms']:.2f} ms" for row in rows if row["implementation"] == OURS)
            LOG.info("%s %d: %s", name, point.varied(name), ", ".join(shown))
    result["slopes"] = fit_slopes(result["rows"])
    result["notes"].append(verdict(result["slopes"]))
    return result


def fit_slopes(rows: Sequence[dict]) -> list[dict]:
    """Slopes of log(time) and log(memory) on log(what is varied), over a whole sweep and over its large end, by least
    squares; times are the least of their repetitions, which other work disturbs least."""
    series: dict[tuple, list[tuple[int, float]]] = {}
    for row in rows:
        for quantity, field in (("time", "min_ms"), ("memory", "peak_memory_bytes")):
            if row.get(field):
                key = row["sweep"], row["implementation"], row["what"], quantity
                series.setdefault(key, []).append((row["varied"], row[field]))
    fields = ("sweep", "implementation", "what", "quantity")
    return [
        dict(zip(fields, key, strict=True)) | {"slope": slope(points), "slope_large": slope(points[-LARGE_END:])}
        for key, points in series.items()
        if len(points) > 1
    ]


def slope(points: Sequence[tuple[float, float]]) -> float:
    """Least squares of log y on log x; at least two points, all positive, not all of one x."""
    xs, ys = zip(*((math.log(x), math.log(y)) for x, y in points), strict=True)
    mean_x, mean_y = sum(xs) / len(xs), sum(ys) / len(ys)
    over, under = zip(*(((x - mean_x) * (y - mean_y), (x - mean_x) ** 2) for x, y in zip(xs, ys, strict=True)))
    return sum(over) / sum(under)


def verdict(slopes: Sequence[dict]) -> str:
    """One sentence on the steepest slope of ours at the large end of a sweep."""
    ours = [row for row in slopes if row["implementation"] == OURS]
    if not ours:
        return "No slopes: a sweep needs two points."
    steep = [row for row in ours if row["slope_large"] > STEEPEST]
    told = steep or [max(ours, key=lambda row: row["slope_large"])]
    lines = (f"{row['slope_large']:.2f} ({row['quantity']} of the {row['what']} over {row['sweep']})" for row in told)
    head = "Steeper than linear at the large end: " if steep else "Nothing is quadratic: the steepest slope is "
    return head + "; ".join(lines) + "."


def _splat_rows(point: Point, device, peer: bool, repetitions: int, budget: float, checks: list[dict]) -> list[dict]:
    scene = make_splat_scene(point.size, point.channels, device)
    if not any(c["what"] == f"{OURS}, {point.channels} channels: image" for c in checks):
        small = make_splat_scene(scene.size.reduced(1000), point.channels, device)
        truth = image_and_gradients(render_reference, small.to("cpu", torch.float64))
        name = f"{OURS}, {point.channels} channels"
        checks += compared(name, "float64", image_and_gradients(render, small), truth)
    renderers = {OURS: lambda: render(scene)}
    if peer:
        renderers[GSPLAT] = gsplat_renderer(scene)
        with torch.no_grad():
            checks.append(check("gsplat: image", OURS, differs(renderers[GSPLAT](), render(scene)), BOUND))
    return _timed(renderers, scene, device, repetitions, budget)


def _timed(renderers: dict, scene: SplatScene, device, repetitions: int, budget: float) -> list[dict]:
    cotangent = scene.cotangent()
    variants = {
        who: Variant(lambda _, call=call: call().backward(cotangent), prepare=scene.clear)
        for who, call in renderers.items()
    }
    rows = []
    for who, timing in time_variants(variants, device, repetitions=repetitions, budget=budget).items():
        # Warp's own scratch stays from the largest call so far, so for ours this is an upper bound.
        held = held_by_warp(device) if who == OURS else 0
        memory = peak_memory(variants[who], device) + held
        rows.append({"implementation": who, "what": SPLAT} | timing | {"peak_memory_bytes": memory})
    return rows


def _step_rows(point: Point, device, peer: bool, repetitions: int, budget: float, checks: list[dict]) -> list[dict]:
    """Whole training steps on photos of this size; on a GPU memory is all that is held, photos, parameters and
    optimizer included. Without densification, which would watch gradients that gsplat gives in another form; steps of
    gsplat are launched, since they cannot be recorded."""
    scene = make_photo_scene(point.size, point.photos, device)
    rows, losses = [], {}
    for who, rasterizer in [(OURS, None), *([(GSPLAT, rasterize_with_gsplat)] if peer else [])]:
        forget_peaks(device)
        fixed = {"densification.stop": 0, "densification.max_gaussians": point.size.gaussians + 1}
        config = load_config(STEP_PRESET, fixed | {"schedule.recorded": who == OURS})
        trainer = make_trainer(scene, config, device, rasterizer)
        variant = step_variant(trainer)
        variant.once()
        losses[who] = trainer.loss
        row = {"implementation": who, "what": STEP}
        row |= time_variants({who: variant}, device, repetitions=repetitions, budget=budget)[who]
        row["peak_memory_bytes"] = held_memory(device) if device.type == "cuda" else peak_memory(variant, device)
        rows.append(row)
        del trainer, variant
    if peer:
        difference = abs(losses[GSPLAT] - losses[OURS]) / abs(losses[OURS])
        checks.append(check("gsplat: loss of the first step", OURS, difference, BOUND))
    return rows
