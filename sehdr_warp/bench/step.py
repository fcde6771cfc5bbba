"""`bench step`: a whole training step (photograph, losses, gradients, optimizer, densification) of a preset."""

import gc
import logging
import math
import statistics
import time
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch

from ..kernels.constants import TILE_SIZE
from ..scene import Scene
from ..splatting.memory import held_by_warp
from ..splatting.reference import rasterize_reference
from ..training.config import Config
from ..training.config_files import load_config
from ..training.initialization import choose_response, make_field
from ..training.trainer import Trainer
from .kernels import OURS, PLAIN_TORCH, PLAIN_TORCH_BYTES
from .results import check, new_result
from .splats import Size, make_photo_scene
from .timing import Variant, peak_memory, summary, time_variants, wait

LOG = logging.getLogger(__name__)
LAUNCHED = "sehdr-warp, launched"
"""The same step without a CUDA graph: each kernel launched from Python."""
CHECKED_STEPS = 4
FIRST_LOSS_BOUND, LATER_LOSS_BOUND = 1e-4, 1e-2
"""Largest relative difference of the loss at the first step (a forward pass) and at the last checked one, which has
the gradients and the optimizer in it; Adam's division makes much of what float32 rounds."""
INTERVALS = {"cuda": 3, "cpu": 1}
"""Densification intervals over which the mean step is taken."""
COLUMNS = {
    "preset": "", "step=implementation": "", "Gaussians=gaussians": ",d", "width": "d", "height": "d",
    "median ms=median_ms": ".3f", "mean ms=mean_ms": ".3f", "with densification=amortized_ms": ".3f",
    "host ms=host_ms": ".3f", "n=repetitions": "d", "peak MiB=peak_memory_bytes": "MiB",
    "ours / this=ours_over_this": ".3f",
}  # fmt: skip


def bench_step(
    size: Size, device: torch.device, *, presets: Sequence[str], repetitions: int, budget: float, views: int = 18
) -> dict:
    """Steps of each preset in the thick of its training (all degrees of the harmonics, densification going on) on
    synthetic photos, recorded and launched on a GPU, beside the plain torch rasterizer on the CPU; a result."""
    settings = {"device": str(device), "presets": list(presets), "repetitions": repetitions, "views": views}
    result = new_result("step", device, settings)
    scene = make_photo_scene(size, views, device)
    for preset in presets:
        # The count may grow by a tenth and no more, so that the times are for the count that was asked for.
        config = load_config(preset, {"densification.max_gaussians": size.gaussians * 11 // 10 + 1})
        fits = _pairs(scene, make_trainer(scene, config, device)) * 16 * 4 <= PLAIN_TORCH_BYTES
        if fits or device.type == "cuda":
            result["checks"] += [c | {"what": f"{preset}: {c['what']}"} for c in _checks(scene, config, device, fits)]
        rows = _rows_on_cuda if device.type == "cuda" else _rows_on_cpu
        made = rows(scene, config, device, repetitions, budget, fits)
        result["rows"] += [{"preset": preset, "width": size.width, "height": size.height} | row for row in made]
        LOG.info("%s: %.3f ms", preset, made[0]["median_ms"])
    return result


def thick_of_training(config: Config) -> int:
    """The first iteration, a multiple of the densification's interval, from which on harmonics and densification are
    at their full cost."""
    every = config.scaled(config.densification.every)
    ready = max(config.model.harmonics_degree * config.schedule.harmonics_every, config.densification.start)
    return -(-(config.scaled(ready) + 1) // every) * every


def make_trainer(scene: Scene, config: Config, device: torch.device, rasterizer: Callable | None = None) -> Trainer:
    """A trainer in the thick of its training, with opacities spread as training spreads them. rasterizer: in place of
    ours."""
    field = make_field(scene, config, choose_response(scene, config), device)
    if rasterizer is not None:
        field.rasterizer = rasterizer
    generator = torch.Generator().manual_seed(config.seed)
    opacities = 0.05 + 0.9 * torch.rand(field.gaussians.count, generator=generator) ** 1.5
    jitter = torch.randn(field.gaussians.count, 3, generator=generator)
    with torch.no_grad():
        field.gaussians.opacity_logits.copy_(torch.logit(opacities))
        # Off the surface by part of their size: a training has something to mend.
        field.gaussians.means.add_(0.3 * field.gaussians.log_scales.exp() * jitter.to(device))
    trainer = Trainer(scene, config, field)
    trainer.iteration = thick_of_training(config)
    return trainer


def step_variant(trainer: Trainer) -> Variant:
    """Steps between two changes of the count: before the next one the iteration goes back to just after the last."""
    first = thick_of_training(trainer.config)

    def between_changes():
        if trainer.iteration + 1 >= first + trainer.config.scaled(trainer.config.densification.every):
            trainer.iteration = first

    return Variant(lambda _: trainer.step(), prepare=between_changes)


def plain_torch_rasterizer(*arguments, capacity=None, deterministic=False, **options):
    """rasterize() in plain torch, for a field."""
    return rasterize_reference(*arguments, **options)


def held_memory(device: torch.device) -> int:
    """The most that torch and Warp held at once since the peaks were last forgotten, bytes."""
    return torch.cuda.max_memory_allocated(device) + held_by_warp(device)


def forget_peaks(device: torch.device) -> None:
    """What is left of the measurement before must not count as the next one's."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def time_steps(trainer: Trainer, repetitions: int) -> dict:
    """Steps on a GPU without a pause between them: their spacing on the device, and the host's time for each."""
    variant, device = step_variant(trainer), trainer.device
    for _ in range(20):
        variant.once()
    events = [torch.cuda.Event(enable_timing=True) for _ in range(repetitions + 1)]
    host = []
    wait(device)
    events[0].record()
    for event in events[1:]:
        variant.prepare()
        started = time.perf_counter()
        trainer.step()
        host.append((time.perf_counter() - started) * 1e3)
        event.record()
    wait(device)
    return summary([a.elapsed_time(b) for a, b in pairwise(events)]) | {"host_ms": statistics.median(host)}


def _rows_on_cuda(scene, config, device, repetitions, budget, fits) -> list[dict]:
    rows = []
    for name, recorded in ((OURS, True), (LAUNCHED, False)):
        forget_peaks(device)
        chosen = config.model_copy(update={"schedule": config.schedule.model_copy(update={"recorded": recorded})})
        trainer = make_trainer(scene, chosen, device)
        row = {"implementation": name, "gaussians": trainer.field.gaussians.count} | time_steps(trainer, repetitions)
        row["peak_memory_bytes"] = held_memory(device)
        rows.append(row | (_amortized(trainer) if recorded else {}))
        del trainer
    return rows


def _rows_on_cpu(scene, config, device, repetitions, budget, fits) -> list[dict]:
    trainers = {OURS: make_trainer(scene, config, device)}
    if fits:
        trainers[PLAIN_TORCH] = make_trainer(scene, config, device, plain_torch_rasterizer)
    variants = {name: step_variant(trainer) for name, trainer in trainers.items()}
    timings = time_variants(variants, device, repetitions=repetitions, budget=budget)
    rows = []
    for name, timing in timings.items():
        row = {"implementation": name, "gaussians": trainers[name].field.gaussians.count} | timing
        row["peak_memory_bytes"] = peak_memory(variants[name], device)
        ratio = None if name == OURS else timings[OURS]["median_ms"] / timing["median_ms"]
        rows.append(row | {"ours_over_this": ratio})
    rows[0] |= _amortized(trainers[OURS])
    return rows


def _amortized(trainer: Trainer) -> dict:
    """The mean step over whole densification intervals, changes of the count included."""
    trainer.iteration = thick_of_training(trainer.config)
    steps = INTERVALS[trainer.device.type] * trainer.config.scaled(trainer.config.densification.every)
    wait(trainer.device)
    started = time.perf_counter()
    for _ in range(steps):
        trainer.step()
    wait(trainer.device)
    mean = (time.perf_counter() - started) * 1e3 / steps
    return {"amortized_ms": mean, "amortized_steps": steps, "gaussians_after": trainer.field.gaussians.count}


def _checks(scene: Scene, config: Config, device: torch.device, fits: bool) -> list[dict]:
    """The loss of the first and of a later step beside the plain torch rasterizer's or, where that would not fit, the
    CPU's kernels."""
    ours = make_trainer(scene, config, device)
    other = make_trainer(scene, config, torch.device("cpu"), plain_torch_rasterizer if fits else None)
    losses = []
    for _ in range(CHECKED_STEPS):
        ours.step()
        other.step()
        losses.append((ours.loss, other.loss))
    made = []
    for step, bound in ((1, FIRST_LOSS_BOUND), (CHECKED_STEPS, LATER_LOSS_BOUND)):
        mine, truth = losses[step - 1]
        difference = abs(mine - truth) / max(abs(truth), 1e-12)
        difference = difference if math.isfinite(difference) else math.inf
        made.append(check(f"loss of step {step}", PLAIN_TORCH if fits else "the CPU's kernels", difference, bound))
    return made


def _pairs(scene: Scene, trainer: Trainer) -> int:
    """Pixel-Gaussian pairs of the first photo."""
    from ..field.radiance_field import CameraTensors

    camera = CameraTensors.of(scene.train_views[0].camera, trainer.device)
    with torch.no_grad():
        return trainer.field.photograph(camera, trainer.field.base_time).rendering.entry_count * TILE_SIZE**2
