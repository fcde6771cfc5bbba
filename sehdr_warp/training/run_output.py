"""Evaluate held-out photos, and write scores, checkpoints, logs and the summary of a training to its run folder."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..errors import SehdrError
from ..evaluation.metrics import psnr
from ..evaluation.protocols import normalize, tone_map
from ..model.confidence import Evidence, gather_evidence
from ..model.radiance_field import RadianceField
from ..model.residual_regions import MAX_LISTED, compare_photos, regions_to_dict
from ..runs.checkpoint import first_not_finite
from ..runs.config import Config, ScheduleConfig
from ..runs.run import Run, load_run
from ..runs.run_writer import RunWriter, write_confidence
from ..scene import View
from .process_settings import machine_figures, summary_writer
from .training_state import state_of

if TYPE_CHECKING:
    from .trainer import Trainer

log = logging.getLogger(__name__)
CURVE_POINTS = 200  # Points of the curves in TensorBoard
LEAST_SECONDS = 10.0  # Between checkpoints, unless the interval is set: one of a million Gaussians takes 1 to 2 s
MAX_DB = 100.0  # Score of identical images, so that a mean over views is finite


class RunOutput:
    """Evaluates and logs a training, and decides when it is saved.

    RunWriter writes the files; load_run() reads them as a Run.
    """

    def __init__(self, folder: RunWriter, config: Config, *, tensorboard: bool = False, is_block: bool = False):
        """Prepare to write a training with a config to its run folder, and event files if `tensorboard`.

        The photos of a block of a larger run (`is_block`) are not compared with it at the end.
        """
        self.folder, self._is_block, self._tensorboard = folder, is_block, tensorboard
        self._writer: Any = None  # Created at the first log
        self._run: Run | None = None
        self._evidence: Evidence | None = None  # Of the photos for the last step's Gaussians
        self._evaluate_at = {config.scaled(n) for n in config.schedule.evaluate_at}
        is_default = config.schedule.checkpoint_every == ScheduleConfig().checkpoint_every
        is_set = not is_default or "schedule.checkpoint_every" in config.plan.keep
        self._least_seconds = 0.0 if is_set else LEAST_SECONDS
        self._saved_at = time.monotonic()
        self._log_every = max(1, config.schedule.iterations // CURVE_POINTS)

    def load_run(self, device: torch.device) -> Run:
        """Return the run as of the newest checkpoint; it is loaded once."""
        self._run = self._run or load_run(self.folder.path, device=device)
        return self._run

    def after_step(self, trainer: Trainer) -> None:
        """Evaluate held-out views, write a checkpoint and log, each if it is due. The last step's are in save_end()."""
        iteration = trainer.iteration
        evaluate = not self._evaluate_at.isdisjoint(range(iteration - trainer.step_batch + 1, iteration + 1))
        evaluate &= iteration < trainer.total
        save = trainer.passed_multiple_of(trainer.config.checkpoint_interval)
        if evaluate or save:
            trainer.synchronize()
        if evaluate:
            self.evaluate(trainer)
        if save and iteration < trainer.total and time.monotonic() - self._saved_at >= self._least_seconds:
            self.checkpoint(trainer)
        if self._tensorboard and trainer.passed_multiple_of(self._log_every):
            figures = {"loss": trainer.loss, "psnr": trainer.psnr()}
            self._log(trainer, "train", figures | {"gaussians": trainer.field.gaussians.count})

    def evaluate(self, trainer: Trainer) -> None:
        """Score the held-out views that a mask does not exclude as a whole, and append the scores to metrics.jsonl."""
        views = [view for view in trainer.scene.test_views if view.mask is None or view.mask.any()]
        if not views:
            return
        scores = evaluate_views(trainer.field, views, trainer.degree)
        line = {"iteration": trainer.iteration, "seconds": round(trainer.seconds, 3), "split": "test"}
        line |= {name: round(value, 4) for name, value in scores.items()}
        self.folder.append_metrics(line | {"gaussians": trainer.field.gaussians.count})
        self._log(trainer, "test", scores)
        log.info("iteration %d: %s, after %.1f s", trainer.iteration, format_scores(scores), trainer.seconds)

    def checkpoint(self, trainer: Trainer, *, last: bool = False) -> None:
        """Write a checkpoint; if the loss is not finite, only the last one, because the training may be diverging.

        Raises:
            SehdrError: If a tensor is not finite.
        """
        state = state_of(trainer)
        if (name := first_not_finite(state.tensors)) is not None:
            raise SehdrError(
                f"iteration {trainer.iteration}: {name} is not finite and was not saved; --resume goes back to "
                "the last good checkpoint; if it happens again, lower the learning rates or check photos and cameras"
            )
        if not last and not math.isfinite(loss := trainer.loss):
            message = "iteration %d: the loss is %s; no checkpoint is written, the last one stays"
            log.warning(message, trainer.iteration, loss)
            return
        self._run = None  # A run that was loaded before is older.
        keep = trainer.config.schedule.keep_checkpoints
        self.folder.write_checkpoint(state.tensors, state.values, keep=keep)
        self._saved_at = time.monotonic()

    def save_end(self, trainer: Trainer) -> None:
        """Write the last checkpoint; after the last step, first remove Gaussians that no photo shows, and evaluate."""
        if trainer.iteration >= trainer.total and trainer.iteration > trainer.first_iteration:
            self._evidence = remove_unseen(trainer)
            self.evaluate(trainer)
        self.checkpoint(trainer, last=True)

    def write_results(self, trainer: Trainer) -> None:
        """Write the summary after save_end(); after the last step, also the confidence and residual regions."""
        self._write_summary(trainer)
        if self._writer is not None:
            self._writer.close()
        if trainer.iteration < trainer.total:
            return
        evidence = self._evidence or self.load_run(trainer.device).measure_confidence(trainer.scene)
        checkpoint_hash = self.folder.checkpoint_hash
        assert checkpoint_hash is not None, "save_end() writes a checkpoint"
        write_confidence(self.folder, evidence, checkpoint_hash)
        if not self._is_block:
            self._compare_photos(trainer, evidence)

    def _write_summary(self, trainer: Trainer) -> None:
        """Write summary.json: times, memory and counts; one of this iteration stays if no step was taken."""
        progress = {"iteration": trainer.iteration, "finished": trainer.iteration >= trainer.total}
        if trainer.iteration == trainer.first_iteration and progress.items() <= self.folder.read_summary().items():
            return
        summary = progress | {
            "train_seconds": round(trainer.seconds, 3),
            "gaussians": trainer.field.gaussians.count,
            "skipped_steps": trainer.skipped_steps,
            "overflowed_steps": trainer.overflowed_steps,
        }
        self.folder.write_summary(summary | machine_figures(trainer.device))

    def _compare_photos(self, trainer: Trainer, evidence: Evidence) -> None:
        """Add to the summary how much light the photos clip, and where they differ from the scene; log the latter."""
        run = self.load_run(trainer.device)
        run.set_evidence(evidence)
        regions, offsets = compare_photos(run.field, trainer.scene.train_views, degree=run.degree)
        light = {"estimated_light": round(estimated_light(run, evidence), 4)}
        unexplained = {"unexplained": regions_to_dict(regions), "brightness_offsets": offsets}
        self.folder.write_summary(run.summary() | light | unexplained)
        if regions:
            worst, photos = regions[0], len({region.photo for region in regions})
            place = f"{worst.photo} at column {worst.column:.0f}, row {worst.row:.0f}, {worst.pixels} pixels"
            stops = f"{abs(worst.stops):.1f} stops {'darker' if worst.stops > 0 else 'brighter'} than the photo"
            message = "%d regions in %d photos are not explained by the scene; the worst: %s %s (summary.json names %d)"
            log.warning(message, len(regions), photos, place, stops, min(len(regions), MAX_LISTED))

    def _log(self, trainer: Trainer, split: str, figures: dict[str, float]) -> None:
        """Write figures to TensorBoard, if that is on."""
        if self._tensorboard:
            # Figures after the checkpoint that a training goes on from are hidden, because they are made again.
            first = trainer.first_iteration + 1
            self._writer = self._writer or summary_writer()(str(self.folder.tensorboard), purge_step=first)
            for name, value in figures.items():
                self._writer.add_scalar(f"{split}/{name}", value, trainer.iteration)


def estimated_light(run: Run, evidence: Evidence) -> float:
    """Return the share in [0, 1] of the light in the training photos that they clip, so that it is an estimate."""
    middle = np.mean([entry.camera.position for entry in run.cameras if entry.split == "train"], 0)
    radiance = run.field.radiance_towards(middle, degree=run.degree).double().mean(1).clamp_max(1e30)
    light = radiance * evidence.weight_sum.to(radiance)
    return float((light * evidence.clipped.to(light)).sum() / light.sum().clamp_min(1e-300))


def remove_unseen(trainer: Trainer) -> Evidence:
    """Remove the Gaussians that no training photo shows; return the evidence of the photos for the others."""
    views, truth = trainer.scene.train_views, trainer.config.loss.uses_hdr
    estimates = None if truth else trainer.data_manager.light_estimates
    certainties = None if estimates is None else [estimate.certainty for estimate in estimates]
    evidence = gather_evidence(trainer.field, views, degree=trainer.degree, truth=truth, certainties=certainties)
    count, contributes = trainer.field.gaussians.count, evidence.contributes
    remaining = int(contributes.sum())
    if remaining == count or remaining == 0:
        return evidence
    trainer.field.gaussians.keep_only(contributes, trainer.optimizer)
    trainer.strategy.load_state_dict({})  # Its statistics are of the rows before.
    log.info("removed %d of %d Gaussians that no training photo shows", count - remaining, count)
    return evidence.rows(contributes)


@torch.no_grad()
def evaluate_views(field: RadianceField, views: Sequence[View], degree: int) -> dict[str, float]:
    """Return mean scores over views, in dB; empty without views.

    Returns:
        "psnr_ldr": Simulated photo against photo, inside the masks. "psnr_mu": HDR against truth in the mu-law,
        protocol "gt-max", over the views with HDR truth.
    """
    device = field.gaussians.means.device
    scores: dict[str, list[float]] = {}
    for view in views:
        mask = None if view.mask is None else torch.tensor(view.mask, device=device)
        photo = torch.tensor(view.image, device=device)
        predicted = field.render_ldr(view.camera, view.exposure_time, degree=degree)
        scores.setdefault("psnr_ldr", []).append(min(psnr(predicted, photo, mask), MAX_DB))
        if view.hdr is not None:
            hdr = field.render(view.camera, degree=degree).hdr
            images = normalize("gt-max", hdr, torch.tensor(view.hdr, device=device), mask)
            scores.setdefault("psnr_mu", []).append(min(psnr(*tone_map("gt-max", *images), mask), MAX_DB))
    return {name: sum(values) / len(values) for name, values in scores.items()}


def format_scores(scores: Mapping[str, float]) -> str:
    """Format the scores of evaluate_views() for a log line."""
    formats = {"psnr_ldr": "held-out photos {:.1f} dB", "psnr_mu": "HDR {:.1f} dB (mu-law)"}
    return ", ".join(text.format(scores[name]) for name, text in formats.items() if name in scores)
