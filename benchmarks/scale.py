"""`bench scale`: how time and memory of splats and training steps grow with Gaussians, pixels, channels and photos."""

import logging
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from sehdr_warp.rasterizer.memory import warp_memory_bytes
from sehdr_warp.runs.config_files import load_config

from .gsplat_peer import BOUND, GSPLAT, gsplat_renderer, note_missing, rasterize_with_gsplat
from .kernels import OURS, against_float64, against_gsplat, render, splat_variant
from .results import check, groups, new_result
from .splats import Size, make_photo_scene, make_splat_scene
from .step import make_trainer, time_step
from .timing import forget_peaks, peak_memory, time_variants

LOG = logging.getLogger(__name__)
COMPARED_CHANNELS = 9
"""gsplat stands beside ours at this count."""
STEP_VIEWS, STEP_PRESET = 2, "paper"
"""The preset with three color sets, nine channels in one pass."""
REFERENCE_GAUSSIANS = 1000
STEEPEST = 1.2
"""A slope above it, at the large end of a sweep, is steeper than linear; 2 is quadratic."""
LARGE_END = 3
"""The large end is a sweep's last so many points."""


def sweeps(device_type: str, small: bool = False) -> dict[str, list[tuple[int, Size, int, int]]]:
    """Return the points of each sweep: what is varied, then size, channels, and photos of the training step (0: none).

    small: every second point, up to a moderate size.
    """
    table = tomllib.loads(Path(__file__).with_name("sweeps.toml").read_text(encoding="utf-8"))[device_type]
    size = Size(table["count"], *table["small_image"])
    result = {
        "gaussians": [(n, Size(n, *table["image"]), COMPARED_CHANNELS, STEP_VIEWS) for n in table["gaussians"]],
        "pixels": [(w * h, Size(table["count"], w, h), COMPARED_CHANNELS, STEP_VIEWS) for w, h in table["pixels"]],
        "channels": [(count, size, count, 0) for count in table["channels"]],
        "photos": [(count, size, COMPARED_CHANNELS, count) for count in table["photos"]],
    }
    return {name: points[:-1:2] if small else points for name, points in result.items()}


def bench_scale(device: torch.device, *, repetitions: int, small: bool = False) -> dict:
    """Time each splat and training step at each point of the sweeps; return rows, and `slopes` of their logarithms."""
    settings = {"device": str(device), "repetitions": repetitions, "small": small, "preset": STEP_PRESET}
    result = new_result("scale", device, settings)
    peer = note_missing(result, device)
    for name, points in sweeps(device.type, small).items():
        for varied, size, channels, photos in points:
            arguments = device, peer and channels == COMPARED_CHANNELS, repetitions, result["checks"]
            rows = [] if name == "photos" else _splat_rows(size, channels, *arguments)
            rows += _step_rows(size, photos, *arguments) if photos else []
            place = {"sweep": name, "varied": varied, "gaussians": size.gaussians, "width": size.width}
            place |= {"height": size.height, "channels": channels, "photos": photos or None}
            result["rows"] += [place | row for row in rows]
            LOG.info("%s %d: done", name, varied)
    result["slopes"] = fit_slopes(result["rows"])
    result["notes"].append(verdict(result["slopes"]))
    return result


def fit_slopes(rows: Sequence[dict]) -> list[dict]:
    """Fit slopes of log(time) and log(memory) on log(what is varied), over a whole sweep and over its large end.

    Times are the least of their repetitions, which other work disturbs least.
    """
    fields, slopes = ("sweep", "implementation", "what"), []
    for key, here in groups(rows, *fields).items():
        for quantity, field in (("time", "min_ms"), ("memory", "peak_memory_bytes")):
            points = [(row["varied"], row[field]) for row in here if row.get(field)]
            if len(points) > 1:
                x, y = np.log(points).T
                fits = {"slope": np.polyfit(x, y, 1), "slope_large": np.polyfit(x[-LARGE_END:], y[-LARGE_END:], 1)}
                row = dict(zip(fields, key, strict=True)) | {"quantity": quantity}
                slopes.append(row | {name: float(slope) for name, (slope, _) in fits.items()})
    return slopes


def verdict(slopes: Sequence[dict]) -> str:
    """One sentence on the steepest slopes of ours at the large end of a sweep."""
    ours = [row for row in slopes if row["implementation"] == OURS]
    if not ours:
        return "No slopes: a sweep needs two points."
    steep = [row for row in ours if row["slope_large"] > STEEPEST]
    worst = steep or [max(ours, key=lambda row: row["slope_large"])]
    lines = (f"{row['slope_large']:.2f} ({row['quantity']} of the {row['what']} over {row['sweep']})" for row in worst)
    head = "Steeper than linear at the large end: " if steep else "Nothing is quadratic: the steepest slope is "
    return head + "; ".join(lines) + "."


def _splat_rows(size: Size, channels: int, device, peer: bool, repetitions: int, checks: list[dict]) -> list[dict]:
    scene = make_splat_scene(size, channels, device)
    name = f"{OURS}, {channels} channels"
    if not any(check["what"].startswith(f"{name}:") for check in checks):
        checks += against_float64(scene, REFERENCE_GAUSSIANS, name)
    variants = {OURS: splat_variant(lambda: render(scene), scene)}
    if peer:
        variants[GSPLAT] = splat_variant(gsplat_renderer(scene), scene)
        checks.append(against_gsplat(scene))
    rows = []
    for who, timing in time_variants(variants, device, repetitions=repetitions).items():
        # Warp's own scratch stays from the largest call so far, so for ours this is an upper bound.
        memory = peak_memory(variants[who], device) + (warp_memory_bytes(device) if who == OURS else 0)
        rows.append({"implementation": who, "what": "splat"} | timing | {"peak_memory_bytes": memory})
    return rows


def _step_rows(size: Size, photos: int, device, peer: bool, repetitions: int, checks: list[dict]) -> list[dict]:
    """Time training steps without densification, whose gradients gsplat gives in another form.

    Steps of gsplat are launched one by one, since they cannot be captured in a CUDA graph.
    """
    scene = make_photo_scene(size, photos, device)
    rows, losses = [], {}
    for who, rasterizer in ({OURS: None} | ({GSPLAT: rasterize_with_gsplat} if peer else {})).items():
        forget_peaks(device)
        fixed = {
            "densification.refine_stop_iter": 0,
            "densification.cap_max": size.gaussians + 1,
            "model.initial_density": 0,
        }
        config = load_config(STEP_PRESET, fixed | {"schedule.use_cuda_graph": who == OURS})
        trainer = make_trainer(scene, config, device, rasterizer)
        trainer.step()
        losses[who] = trainer.loss
        rows.append({"implementation": who, "what": "training step"} | time_step(trainer, repetitions))
        del trainer
    forget_peaks(device)
    if peer:
        difference = abs(losses[GSPLAT] - losses[OURS]) / abs(losses[OURS])
        checks.append(check("gsplat: loss of the first step", OURS, difference, BOUND))
    return rows
