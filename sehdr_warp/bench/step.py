"""`bench step`: a whole training step (photograph, losses, gradients, optimiser, densification) of a preset."""

import math
import statistics
import time
from collections.abc import Callable
from contextlib import contextmanager
from itertools import pairwise
from unittest.mock import patch

import torch
from torch.profiler import ProfilerActivity, profile

from ..errors import SehdrError
from ..field import radiance_field
from ..kernels.constants import TILE_SIZE
from ..scene import Scene
from ..splatting.reference import rasterize_reference
from ..training.config import Config
from ..training.config_files import load_config
from ..training.initialization import choose_response, make_field
from ..training.trainer import Trainer
from .checks import Check
from .kernels import OURS, PLAIN_TORCH, PLAIN_TORCH_BYTES
from .report import new_report
from .scenes import make_photo_scene
from .splats import Size
from .timing import Timing, Variant, peak_memory, time_variants

CHECKED_STEPS = 4
FIRST_LOSS_BOUND, LATER_LOSS_BOUND = 1e-4, 1e-2
"""Largest relative difference of the loss at the first step (a forward pass) and at the last checked one, which has
the gradients and the optimiser in it; Adam's division makes much of what float32 rounds."""
INTERVALS = {"cuda": 3, "cpu": 1}
"""Densification intervals over which the mean step is taken."""
PROFILED_STEPS = 20


def bench_step(
    size: Size,
    device: torch.device,
    *,
    preset: str = "default",
    repetitions: int = 30,
    budget: float = 20.0,
    plain_torch: bool = True,
    progress: Callable[[str], None] = lambda line: None,
) -> dict:
    """Time and check; returns the report.

    The training is taken in its thick: all degrees of the harmonics, full size, densification going on. plain_torch:
    on the CPU, compare with the same step on the plain torch rasterizer in float32. repetitions, budget: see
    time_variants.
    """
    # The count may grow by a tenth and no more, so that the times are for the count that was asked for.
    config = load_config(preset, {"densification.max_gaussians": size.gaussians * 11 // 10 + 1})
    report = new_report("step", device, {"device": str(device), "preset": preset, "repetitions": repetitions})
    scene = make_photo_scene(size)
    progress(f"{scene.name}: {len(scene.views)} photos")
    first = thick_of_training(config)
    report["settings"] |= {"first_iteration": first + 1, "views": len(scene.views)}
    plain_fits = _pairs(scene, make_trainer(scene, config, device, first)) * 16 * 4 <= PLAIN_TORCH_BYTES
    report["checks"] = [check.to_dict() for check in _checks(scene, config, device, first, plain_fits)]
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    trainer = make_trainer(scene, config, device, first)
    row = _row(OURS, size, trainer)
    if device.type == "cuda":
        row |= _time_on_cuda(trainer, first, repetitions)
        row["peak_memory_bytes"] = torch.cuda.max_memory_allocated(device)
        report["rows"].append(row)
    else:
        variants = {OURS: _step_variant(trainer, first)}
        if plain_torch and plain_fits:
            plain = make_trainer(scene, config, device, first)
            variants[PLAIN_TORCH] = _plain_variant(plain, first)
        elif plain_torch:
            report["notes"].append(f"{PLAIN_TORCH} not compared: it would need more than 4 GiB")
        timings = time_variants(variants, device, repetitions=repetitions, budget=budget)
        for name, timing in timings.items():
            made = (row if name == OURS else _row(name, size, plain)) | timing.to_dict()
            made["peak_memory_bytes"] = peak_memory(variants[name], device)
            made["ours_over_this"] = None if name == OURS else timings[OURS].median / timing.median
            report["rows"].append(made)
    progress(f"{OURS}: {report['rows'][0]['median_ms']:.3f} ms")
    report["rows"][0] |= _amortised(trainer, first)
    return report


def thick_of_training(config: Config) -> int:
    """The first iteration, a multiple of the densification's interval, from which on harmonics and densification
    are at their full cost."""
    schedule, densification = config.schedule, config.densification
    ready = max(config.model.harmonics_degree * schedule.harmonics_every, densification.start)
    every = config.scaled(densification.every)
    return -(-(config.scaled(ready) + 1) // every) * every


def make_trainer(scene: Scene, config: Config, device: torch.device, iteration: int) -> Trainer:
    """A trainer at an iteration, with opacities spread as training spreads them."""
    field = make_field(scene, config, choose_response(scene, config), device)
    generator = torch.Generator().manual_seed(config.seed)
    opacities = 0.05 + 0.9 * torch.rand(field.gaussians.count, generator=generator) ** 1.5
    jitter = torch.randn(field.gaussians.count, 3, generator=generator)
    with torch.no_grad():
        field.gaussians.opacity_logits.copy_(torch.logit(opacities))
        # Off the surface by part of their size: a training has something to mend.
        field.gaussians.means.add_(0.3 * field.gaussians.log_scales.exp() * jitter.to(device))
    trainer = Trainer(scene, config, field)
    trainer.iteration = iteration
    return trainer


def _row(name: str, size: Size, trainer: Trainer) -> dict:
    return {
        "stage": "step",
        "implementation": name,
        "gaussians": trainer.field.gaussians.count,
        "width": size.width,
        "height": size.height,
    }


def _pairs(scene: Scene, trainer: Trainer) -> int:
    """Pixel-Gaussian pairs of the first photo."""
    field = trainer.field
    camera = radiance_field.CameraTensors.of(scene.train_views[0].camera, trainer.device)
    with torch.no_grad():
        return field.photograph(camera, field.base_time).rendering.entry_count * TILE_SIZE**2


def _step_variant(trainer: Trainer, first: int) -> Variant:
    return Variant(lambda _: trainer.step(), prepare=lambda: between_changes(trainer, first))


def _plain_variant(trainer: Trainer, first: int) -> Variant:
    def run(_):
        with plain_torch_rasterizer():
            trainer.step()

    return Variant(run, prepare=lambda: between_changes(trainer, first))


def between_changes(trainer: Trainer, first: int) -> None:
    """Before the next step would change the number of Gaussians, go back to just after the last change."""
    if trainer.iteration + 1 >= first + trainer.densification.every:
        trainer.iteration = first


@contextmanager
def plain_torch_rasterizer():
    """Within this block every field renders with the plain torch rasterizer. Raises SehdrError if none did."""
    calls = 0

    def rasterize(*arguments, capacity=None, style=None, **options):
        nonlocal calls
        calls += 1
        return rasterize_reference(*arguments, **options)

    with patch.object(radiance_field, "rasterize", rasterize):
        yield
    if not calls:
        raise SehdrError(
            "the plain torch rasterizer was not used by the step; the comparison would be of ours with ours"
        )


def _checks(scene: Scene, config: Config, device: torch.device, first: int, plain_fits: bool) -> list[Check]:
    """The loss of the first and of a later step, by us and by the plain torch rasterizer or, where that would not
    fit, by the CPU's kernels."""
    ours = make_trainer(scene, config, device, first)
    other = make_trainer(scene, config, torch.device("cpu"), first)
    if device.type == "cpu" and not plain_fits:
        return []
    against = f"{PLAIN_TORCH} rasterizer" if plain_fits else "CPU kernels"
    losses = []
    for _ in range(CHECKED_STEPS):
        ours.step()
        if plain_fits:
            with plain_torch_rasterizer():
                other.step()
        else:
            other.step()
        losses.append((ours.loss, other.loss))
    bounds = {1: FIRST_LOSS_BOUND, CHECKED_STEPS: LATER_LOSS_BOUND}
    made = []
    for step, bound in bounds.items():
        mine, truth = losses[step - 1]
        difference = abs(mine - truth) / max(abs(truth), 1e-12)
        difference = difference if math.isfinite(difference) else math.inf
        made.append(Check(f"{OURS}: loss of step {step}", against, scene.name, 3, difference, bound))
    return made


def _time_on_cuda(trainer: Trainer, first: int, repetitions: int) -> dict:
    """Steps without a pause between them: their spacing on the device, the host's time for each, and how long the
    device was busy."""
    device = trainer.device
    for _ in range(20):
        between_changes(trainer, first)
        trainer.step()
    events = [torch.cuda.Event(enable_timing=True) for _ in range(repetitions + 1)]
    host = []
    torch.cuda.synchronize(device)
    events[0].record()
    for event in events[1:]:
        between_changes(trainer, first)
        started = time.perf_counter()
        trainer.step()
        host.append((time.perf_counter() - started) * 1e3)
        event.record()
    torch.cuda.synchronize(device)
    timing = Timing(tuple(a.elapsed_time(b) for a, b in pairwise(events)))
    with profile(activities=[ProfilerActivity.CUDA]) as recorded:
        for _ in range(PROFILED_STEPS):
            between_changes(trainer, first)
            trainer.step()
        torch.cuda.synchronize(device)
    averages = [entry for entry in recorded.key_averages() if entry.self_device_time_total > 0]
    averages.sort(key=lambda entry: -entry.self_device_time_total)
    per_step = 1e-3 / PROFILED_STEPS
    return timing.to_dict() | {
        "host_ms": statistics.median(host),
        "device_ms": sum(entry.self_device_time_total for entry in averages) * per_step,
        "device_operations_per_step": sum(entry.count for entry in averages) / PROFILED_STEPS,
        "longest_on_device": [
            {"name": entry.key[:120], "ms_per_step": entry.self_device_time_total * per_step} for entry in averages[:12]
        ],
    }


def _amortised(trainer: Trainer, first: int) -> dict:
    """The mean step over whole densification intervals, everything included; and how the count changed."""
    densification, device = trainer.densification, trainer.device
    trainer.iteration = first
    before, changes = trainer.field.gaussians.count, 0
    steps = INTERVALS[device.type] * densification.every
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    started = time.perf_counter()
    for _ in range(steps):
        trainer.step()
        due = trainer.iteration % densification.every == 0
        changes += due and densification.start < trainer.iteration < densification.stop
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    mean = (time.perf_counter() - started) * 1e3 / steps
    return {
        "amortised_ms": mean,
        "amortised_steps": steps,
        "densifications": changes,
        "gaussians_after": trainer.field.gaussians.count,
        "gaussians_before": before,
    }
