"""`python -m benchmarks step`: a training step of a preset, from the render to densification."""

import logging
import statistics
import time
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch

from sehdr_warp.rasterizer import rasterize
from sehdr_warp.rasterizer.reference import rasterize_reference
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import load_config, override_config
from sehdr_warp.scene import Scene
from sehdr_warp.training.initialization import make_field, response_for_training
from sehdr_warp.training.process_settings import torch_settings
from sehdr_warp.training.ranks import Ranks
from sehdr_warp.training.trainer import Trainer

from .kernels import OURS, PLAIN_TORCH, REFERENCE_GAUSSIANS
from .parts import parts_of_step, work_of
from .results import check, new_result
from .splats import Size, make_photo_scene
from .timing import Variant, forget_peaks, held_memory, peak_memory, summary, time_variants, wait

LOG = logging.getLogger(__name__)
LAUNCHED = "sehdr-warp, launched"  # The same step without a CUDA graph: each kernel launched from Python
CHECKED_STEPS = 4
FIRST_LOSS_BOUND, LATER_LOSS_BOUND = 1e-4, 1e-2
"""Largest relative difference of the loss at the first step (a forward pass) and at the last checked one, which has
the gradients and the optimizer in it; Adam's division makes much of what float32 rounds."""
INTERVALS = {"cuda": 3, "cpu": 1}  # Densification intervals over which the mean step is taken


def bench_step(size: Size, device: torch.device, *, presets: Sequence[str], repetitions: int, views: int = 18) -> dict:
    """Time steps of each preset in the thick of its training on synthetic photos; return the result.

    All degrees of the harmonics are on, and densification goes on. On a GPU steps are recorded, and launched one by
    one; `parts` are those of the recorded step.
    """
    settings = {"device": str(device), "presets": list(presets), "repetitions": repetitions, "views": views}
    result = new_result("step", device, settings)
    if device.type == "cuda":
        result["parts"] = []
    scene = make_photo_scene(size, views, device)
    for preset in presets:
        # No points but the scene's, and growth by a tenth at most: the times are for the count that was asked for.
        most = size.gaussians * 11 // 10 + 1
        config = load_config(preset, {"densification.cap_max": most, "model.initial_density": 0})
        if config.response.name == "auto":  # to choose it takes longer than to time
            config = override_config(config, {"response.name": "srgb"})
        if device.type == "cuda":
            result["checks"] += _checks(preset, scene, config, device, "the CPU's kernels")
        else:
            small = make_photo_scene(size.reduced(REFERENCE_GAUSSIANS), views)
            result["checks"] += _checks(preset, small, config, device, PLAIN_TORCH, _plain_torch)
        place = {"preset": preset, "width": size.width, "height": size.height}
        result["rows"] += [place | row for row in _rows(scene, config, device, repetitions)]
        if device.type == "cuda":
            result["parts"] += [{"preset": preset} | row for row in _parts(scene, config, device)]
        LOG.info("%s: done", preset)
    return result


def thick_of_training(config: Config) -> int:
    """Return the first iteration with all harmonics, at a densification step, from which on steps cost most."""
    every = config.scaled(config.densification.refine_every)
    ready = max(config.model.sh_degree * config.schedule.sh_degree_interval, config.densification.refine_start_iter)
    return -(-(config.scaled(ready) + 1) // every) * every


def make_trainer(
    scene: Scene, config: Config, device: torch.device, rasterizer: Callable | None = None, ranks: Ranks | None = None
) -> Trainer:
    """Return a trainer in the thick of its training, with opacities spread as training spreads them.

    rasterizer: in place of ours. ranks: that train together, each of which makes the same trainer.
    """
    field = make_field(scene, config, response_for_training(scene, config), device)
    field.rasterizer = rasterizer or field.rasterizer
    generator = torch.Generator().manual_seed(config.seed)
    opacities = 0.05 + 0.9 * torch.rand(field.gaussians.count, generator=generator) ** 1.5
    jitter = torch.randn(field.gaussians.count, 3, generator=generator)
    with torch.no_grad():
        field.gaussians.opacity_logits.copy_(torch.logit(opacities))
        # Off the surface by part of their size: a training has something to mend.
        field.gaussians.means.add_(0.3 * field.gaussians.log_scales.exp() * jitter.to(device))
    trainer = Trainer(scene, config, field, ranks=ranks)
    trainer.iteration = thick_of_training(config)
    return trainer


def step_variant(trainer: Trainer) -> Variant:
    """Time steps between two changes of the count; the iteration goes back before the next one."""
    first = thick_of_training(trainer.config)

    def between_changes():
        if trainer.iteration + trainer.batch >= first + trainer.config.scaled(
            trainer.config.densification.refine_every
        ):
            trainer.iteration = first

    return Variant(trainer.step, prepare=between_changes)


def time_step(trainer: Trainer, repetitions: int) -> dict:
    """Time a step and its memory: on a GPU all that is held, on the CPU what the step adds."""
    variant, device = step_variant(trainer), trainer.device
    with torch_settings(trainer.config.deterministic):
        timing = time_variants({"step": variant}, device, repetitions=repetitions)["step"]
    return timing | {"peak_memory_bytes": held_memory(device) or peak_memory(variant, device)}


def _time_row_of_steps(trainer: Trainer, repetitions: int) -> dict:
    """Time steps on a GPU without a pause between them: their spacing on the device, and the host's time for each."""
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
    timing = summary([a.elapsed_time(b) for a, b in pairwise(events)]) | {"host_ms": statistics.median(host)}
    return timing | {"peak_memory_bytes": held_memory(device)}


def _rows(scene: Scene, config: Config, device: torch.device, repetitions: int) -> list[dict]:
    rows = []
    for name in (OURS, LAUNCHED) if device.type == "cuda" else (OURS,):
        forget_peaks(device)
        trainer = make_trainer(scene, override_config(config, {"schedule.use_cuda_graph": name == OURS}), device)
        row = {"implementation": name, "gaussians": trainer.field.gaussians.count}
        row |= (_time_row_of_steps if device.type == "cuda" else time_step)(trainer, repetitions)
        if rows:
            row["ours_over_this"] = rows[0]["median_ms"] / row["median_ms"]
        else:
            with torch_settings(config.deterministic):
                row |= amortize(trainer, trainer.step)
        rows.append(row)
        del trainer
    return rows


def _parts(scene: Scene, config: Config, device: torch.device) -> list[dict]:
    """parts_of_step() of the recorded step."""
    calls: list[tuple] = []

    def rasterizer(*arguments, **options):
        calls[:] = [arguments]
        return rasterize(*arguments, **options)

    make_trainer(scene, override_config(config, {"schedule.use_cuda_graph": False}), device, rasterizer).step()
    work = work_of(calls[0], 3 * (config.model.sh_degree + 1) ** 2)
    return parts_of_step(step_variant(make_trainer(scene, config, device)), work, device)


def _plain_torch(*arguments, max_intersections=None, deterministic=False, **options):
    return rasterize_reference(*arguments, **options)


def amortize(trainer: Trainer, step: Callable[[], object]) -> dict:
    """Return the mean step over whole densification intervals, changes of the count included."""
    trainer.iteration = thick_of_training(trainer.config) - 1
    step()  # the first change prepares what the others use
    photos = INTERVALS[trainer.device.type] * trainer.config.scaled(trainer.config.densification.refine_every)
    steps = -(-photos // trainer.batch)
    wait(trainer.device)
    started = time.perf_counter()
    for _ in range(steps):
        step()
    wait(trainer.device)
    mean = (time.perf_counter() - started) * 1e3 / steps
    return {"amortized_ms": mean, "amortized_steps": steps, "gaussians_after": trainer.field.gaussians.count}


def _checks(preset: str, scene: Scene, config: Config, device, against: str, rasterizer=None) -> list[dict]:
    """Compare the loss of the first and of a later step with that of a training on the CPU by this rasterizer."""
    ours, other = make_trainer(scene, config, device), make_trainer(scene, config, torch.device("cpu"), rasterizer)
    checks = []
    for step in range(1, CHECKED_STEPS + 1):
        ours.step()
        other.step()
        if bound := {1: FIRST_LOSS_BOUND, CHECKED_STEPS: LATER_LOSS_BOUND}.get(step):
            difference = abs(ours.loss - other.loss) / max(abs(other.loss), 1e-12)
            checks.append(check(f"{preset}: loss of step {step}", against, difference, bound))
    return checks
