"""`bench scale`: how time and memory grow with Gaussians, pixels and channels, stage by stage, and how steeply."""

import gc
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from unittest.mock import patch

import torch

from ..errors import SehdrError
from ..field import radiance_field
from ..splatting.memory import held_by_warp
from ..splatting.rasterization import rasterize
from ..training.config import Config
from ..training.config_files import load_config
from . import checks
from .kernels import OURS
from .peer_gsplat import rasterize_with_gsplat, spherical_harmonics_with_gsplat
from .peers import Peer, find_peers
from .report import new_report
from .scenes import make_photo_scene
from .slopes import fit_slopes
from .splats import Size, SplatScene, make_splat_scene
from .stages import prepare, stage_variants
from .step import between_changes, make_trainer, thick_of_training
from .timing import Variant, peak_memory, time_variants

COMPARED_CHANNELS = 9
"""gsplat's time and memory stand beside ours at this count."""
STEP_VIEWS = 2
STEP_PRESET = "paper"
"""The preset with three colour sets, nine channels in one pass."""
WHOLE_STEP, WHOLE_SPLAT = "training step", "splat, forward + backward"
GSPLAT, GSPLAT_AND_HARMONICS = "gsplat", "gsplat and its harmonics"
"""Steps with gsplat's rasterizer in place of ours, all else alike; and with its spherical harmonics too, as whoever
builds on gsplat would take them."""


@dataclass(frozen=True)
class Sweep:
    """One quantity varied, the others held. name: gaussians, pixels or channels."""

    name: str
    points: tuple[tuple[Size, int], ...]
    """(size, channels) of each point, ascending."""


def sweeps(device_type: str) -> dict[str, Sweep]:
    """The sweeps of a device, by name."""
    if device_type == "cuda":
        counts = (10_000, 30_000, 100_000, 300_000, 1_000_000, 2_500_000, 5_000_000)
        images = ((200, 200), (400, 400), (800, 800), (1600, 1200), (2560, 1440), (3840, 2160))
        gaussians = [(Size(count, 1600, 1200), 9) for count in counts]
        pixels = [(Size(200_000, *image), 9) for image in images]
        channels = [(Size(200_000, 800, 800), count) for count in (3, 4, 6, 9, 12, 16, 24, 32, 48)]
    else:
        counts, sides = (1000, 2500, 5000, 10_000, 20_000, 50_000), (64, 128, 256, 512)
        gaussians = [(Size(count, 200, 200), 9) for count in counts]
        pixels = [(Size(5000, side, side), 9) for side in sides]
        channels = [(Size(5000, 200, 200), count) for count in (3, 6, 9, 16, 24, 48)]
    made = (("gaussians", gaussians), ("pixels", pixels), ("channels", channels))
    return {name: Sweep(name, tuple(points)) for name, points in made}


def parse_sweeps(text: str, device_type: str) -> list[Sweep]:
    """Sweeps from `gaussians,pixels`. Raises SehdrError for a name that is none."""
    known = sweeps(device_type)
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in known:
            raise SehdrError(f"--sweeps {text}: {name!r} is none; use {', '.join(known)}")
    return [known[name] for name in names]


def bench_scale(
    chosen: list[Sweep],
    device: torch.device,
    *,
    peers: bool = True,
    steps: bool = True,
    repetitions: int = 30,
    budget: float = 5.0,
    progress: Callable[[str], None] = lambda line: None,
) -> dict:
    """Time, weigh and check; returns the report.

    peers: gsplat beside ours at nine channels, where it imports. steps: also whole training steps, in the sweeps over
    Gaussians and pixels. repetitions, budget: see time_variants.
    """
    settings = {"device": str(device), "repetitions": repetitions, "cpu_seconds_per_variant": budget}
    report = new_report("scale", device, settings | {"sweeps": [sweep.name for sweep in chosen]})
    found, notes = find_peers(device) if peers else ([], ["gsplat not compared: not asked for (--peers)"])
    gsplat = next((peer for peer in found if peer.name == GSPLAT), None)
    report["notes"] += [note for note in notes if note.startswith("gsplat")]
    checked: set[int] = set()
    for sweep in chosen:
        for size, channels in sweep.points:
            beside = gsplat if channels == COMPARED_CHANNELS else None
            scene = make_splat_scene(size, channels).to(device)
            if channels not in checked:
                report["checks"] += _checks(scene)
                checked.add(channels)
            report["rows"] += _splat_rows(sweep.name, scene, beside, repetitions, budget, report)
            del scene
            _empty(device)
            if steps and sweep.name != "channels":
                report["rows"] += _step_rows(sweep.name, size, device, beside, repetitions, budget, report)
                _empty(device)
            progress(_line(sweep.name, size, channels, report["rows"]))
    slopes = fit_slopes(report["rows"])
    report["rows"] += slopes
    report["notes"].append(verdict(slopes))
    return report


def verdict(slopes: list[dict]) -> str:
    """One sentence on the steepest slope at the large end of a sweep, of any stage of ours."""
    ours = [row for row in slopes if row["implementation"] == OURS]
    if not ours:
        return "no slopes: a sweep needs two points"
    steep = [row for row in ours if row["too_steep"]]
    if not steep:
        worst = max(ours, key=lambda row: row["slope_large"])
        return f"no step quadratic: the steepest slope at the large end is {_slope(worst)}"
    return "steeper than linear at the large end: " + "; ".join(_slope(row) for row in steep)


def _slope(row: dict) -> str:
    return (
        f"{row['slope_large']:.2f} ({row['quantity']} of {row['what']} over {row['sweep']}, "
        f"{row['large_from']:,d} to {row['large_to']:,d})"
    )


def _render(scene: SplatScene) -> torch.Tensor:
    return rasterize(*scene.arguments).image


def _checks(scene: SplatScene) -> list[dict]:
    small = make_splat_scene(scene.size.reduced(checks.REFERENCE_GAUSSIANS // 4), scene.channels).to(scene.device)
    return [check.to_dict() for check in checks.check_against_reference(OURS, _render, small)]


def _splat_rows(name, scene: SplatScene, gsplat: Peer | None, repetitions, budget, report) -> list[dict]:
    """A row for each stage, and for the whole splat of ours and of gsplat, with its peak memory."""
    device, cotangent = scene.device, scene.cotangent()
    prepared = prepare(scene)
    renderers = {OURS: lambda: _render(scene)}
    if gsplat is not None:
        renderers[GSPLAT] = gsplat.renderer(scene)
        with torch.no_grad():
            difference = checks.differs(renderers[GSPLAT](), _render(scene))
        found = checks.Check("gsplat: image", OURS, str(scene.size), scene.channels, difference, gsplat.bound)
        report["checks"].append(found.to_dict())
    variants = {(OURS, stage): variant for stage, variant in stage_variants(scene, prepared).items()}
    for who, render in renderers.items():
        variants[who, WHOLE_SPLAT] = Variant(lambda _, render=render: render().backward(cotangent), prepare=scene.clear)
    timings = time_variants(variants, device, repetitions=repetitions, budget=budget)
    entries = prepared.lists.entry_count
    rows = []
    for (who, stage), timing in timings.items():
        row = _row(name, scene.size, scene.channels, who, stage) | {"entries": entries} | timing.to_dict()
        row["entries_per_tile"] = entries / max(1, prepared.lists.ranges.shape[0])
        if stage == WHOLE_SPLAT:
            row["peak_memory_bytes"] = peak_memory(variants[who, stage], device)
            if who == OURS:
                # Warp's own scratch stays from the largest call so far, so this is an upper bound.
                row["peak_memory_bytes"] += held_by_warp(device)
                row["warp_memory_bytes"] = held_by_warp(device)
        rows.append(row)
    return rows


def _step_rows(name: str, size: Size, device, gsplat: Peer | None, repetitions, budget, report) -> list[dict]:
    """Whole training steps of the preset on photos of this size; peak memory is all that is held on a GPU, photos,
    parameters and optimiser included."""
    scene = make_photo_scene(size, views=STEP_VIEWS, device=device)
    first = thick_of_training(_step_config(OURS, size))
    rows, losses = [], {}
    for who in (OURS,) if gsplat is None else (OURS, GSPLAT, GSPLAT_AND_HARMONICS):
        _empty(device)
        with _kernels_of(who):
            trainer = make_trainer(scene, _step_config(who, size), device, first)
            variant = Variant(lambda _, t=trainer: t.step(), prepare=lambda t=trainer: between_changes(t, first))
            variant.once()
            losses[who] = trainer.loss
            # One variant: turns would only add untimed runs.
            timing = time_variants({who: variant}, device, repetitions=repetitions, budget=budget)[who]
        row = _row(name, size, COMPARED_CHANNELS, who, WHOLE_STEP) | timing.to_dict()
        if device.type == "cuda":
            row["peak_memory_bytes"] = torch.cuda.max_memory_allocated(device)
            row["requested_memory_bytes"] = torch.cuda.memory_stats(device)["requested_bytes.all.peak"]
            row["reserved_memory_bytes"] = torch.cuda.max_memory_reserved(device)
            if who == OURS:
                row["peak_memory_bytes"] += held_by_warp(device)
                row["warp_memory_bytes"] = held_by_warp(device)
        else:
            row["peak_memory_bytes"] = peak_memory(variant, device)
        rows.append(row)
        del trainer, variant
        if who != OURS:
            difference = abs(losses[who] - losses[OURS]) / abs(losses[OURS])
            found = checks.Check(
                f"{who}: loss of the first step", OURS, str(size), COMPARED_CHANNELS, difference, gsplat.bound
            )
            report["checks"].append(found.to_dict())
    return rows


def _step_config(who: str, size: Size) -> Config:
    """Without densification, which on both sides would watch gradients that gsplat gives in another form; steps of
    gsplat are launched, since they cannot be recorded as a CUDA graph."""
    return load_config(
        STEP_PRESET,
        {
            "densification.stop": 0,
            "densification.max_gaussians": size.gaussians + 1,
            "schedule.recorded": who == OURS,
        },
    )


@contextmanager
def _kernels_of(who: str):
    """Within the block training steps run on our kernels, or on gsplat's where it has them."""
    with ExitStack() as replaced:
        if who != OURS:
            replaced.enter_context(patch.object(radiance_field, "rasterize", rasterize_with_gsplat))
        if who == GSPLAT_AND_HARMONICS:
            replaced.enter_context(patch.object(radiance_field, "spherical_harmonics", spherical_harmonics_with_gsplat))
        yield


def _empty(device: torch.device) -> None:
    """What is left of the point before must not count as this one's."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def _row(sweep: str, size: Size, channels: int, implementation: str, what: str) -> dict:
    varied = {"gaussians": size.gaussians, "pixels": size.width * size.height, "channels": channels}
    return {
        "stage": "scale",
        "sweep": sweep,
        "varied": varied[sweep],
        "gaussians": size.gaussians,
        "width": size.width,
        "height": size.height,
        "channels": channels,
        "implementation": implementation,
        "what": what,
    }


def _line(sweep: str, size: Size, channels: int, rows: list[dict]) -> str:
    here = (sweep, size.gaussians, size.width, size.height, channels)
    keys = ("sweep", "gaussians", "width", "height", "channels")
    shown = ", ".join(
        f"{row['what']} {row['median_ms']:.2f} ms"
        for row in rows
        if row["what"] in (WHOLE_SPLAT, WHOLE_STEP)
        and row["implementation"] == OURS
        and tuple(row[key] for key in keys) == here
    )
    return f"{sweep}: {size}, {channels} channels: {shown}"
