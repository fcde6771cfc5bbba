"""A whole training: run folder, steps, held-out tests, checkpoints, and a tidy end however it comes."""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError, SehdrError
from ..model.confidence import Evidence, gather_evidence
from ..model.radiance_field import RenderedView
from ..model.residual_regions import MAX_LISTED, find_residual_regions, regions_to_dict
from ..rasterizer.memory import TRAINING_REMEDY, oom_context
from ..response import Response
from ..runs.checkpoint import first_not_finite
from ..runs.config import Config
from ..runs.config_files import as_config, config_fields, override_config
from ..runs.device import pick_device
from ..runs.run import Run, as_rec709, field_from_checkpoint, load_run, photo_gains
from ..runs.run_writer import RunWriter, write_confidence
from ..scene import Camera, Scene
from ..scene.exposure_compensation import ExposureCompensation
from ..scene.normalization import normalization_of
from .compensation import estimate_compensation, estimates_compensation
from .following import hand_on, told_of_ranks
from .held_out import evaluate_views, format_scores, warn_of_overfitting
from .initialization import choose_response, make_field, make_matcher, sizes_of
from .machine import interruptible, machine_figures, summary_writer, torch_settings
from .plan import apply_plan
from .ranks import END, GO, WAIT, Ranks
from .targets import check_truth
from .trainer import Trainer

log = logging.getLogger(__name__)


class Step:
    """What a training tells after a step.

    `loss`, `psnr` (dB, of the step's photo) and `gaussians` are read when they are asked for, until the next step.

    Attributes:
        iteration: steps done.
        total: steps in all.
        seconds: of training so far.
        seconds_left: expected to the end; None at first.
    """

    def __init__(self, training: "Training"):
        self._training = training
        self.iteration, self.total, self.seconds = training.iteration, training.total, training.seconds
        self.seconds_left: float | None = None

    @property
    def loss(self) -> float:
        return self._training.timed(lambda: self._training.trainer.loss)

    @property
    def psnr(self) -> float:
        return self._training.timed(self._training.trainer.psnr)

    @property
    def gaussians(self) -> int:
        return self._training.trainer.field.gaussians.count


class Training:
    """A training, step by step: iterate over it, and each step is made as it is asked for.

        training = Training(scene, "run", "fast")
        for step in training:
            if step.iteration % 100 == 0:
                print(step.iteration, step.psnr, step.seconds_left)
        run = training.run

    Leaving the loop, or stop(), ends the training: a checkpoint is written, and resume=True goes on from there. While
    it is iterated, torch runs on one thread, and the first SIGINT, SIGTERM or SIGHUP ends it after a step: it takes
    effect (KeyboardInterrupt) once the checkpoint is written. Until then no other training may use the folder.

    Args:
        scene: of load_scene; its training views are trained on, its test views are the held-out ones.
        out: the folder of the run.
        config: a Config, a preset's name or file, or a mapping of fields that differ from the default preset; by
            default that preset, or, resuming, the run's own config.
        device: "cpu", "cuda:0", ...; by default the first GPU if there is one.
        resume: continue the run in `out` from its newest complete checkpoint: on the CPU the result is bit for bit
            that of an uninterrupted training.
        overwrite: replace the run in `out`, once there is a checkpoint of the new one's start.
        tensorboard: event files in out/tensorboard (needs the extra `tensorboard`).
        data: how load_scene made the scene ("path", "exposure_index", "max_size" ...), saved to load it again.
        ranks: the processes that train together, of which this one leads.

    Raises:
        InputError: for a scene, folder or config that cannot be used.
        SehdrError: if the training diverges or the disk or the memory is full.
    """

    def __init__(
        self,
        scene: Scene,
        out: Path | str,
        config: Config | str | Path | Mapping[str, Any] | None = None,
        *,
        device: str | torch.device | None = None,
        resume: bool = False,
        overwrite: bool = False,
        tensorboard: bool = False,
        data: dict[str, Any] | None = None,
        ranks: Ranks | None = None,
    ):
        self.folder, self.ranks = RunWriter(out), ranks
        self.device = pick_device(device)
        make_writer = summary_writer() if tensorboard else None
        config = as_config(config)
        self.seconds = 0.0
        with oom_context(self.device, lambda: sizes_of(scene), TRAINING_REMEDY):
            self.scene = scene
            resumed = self.folder.check(resume=resume, overwrite=overwrite)
            try:
                if resumed:
                    self.trainer = self._continue(config)
                else:
                    self.trainer = self._begin(scene, config or Config(), data or {}, overwrite)
                if ranks is not None:
                    hand_on(ranks, self.scene, self.trainer)
            except BaseException:
                self.folder.unlock()
                raise
        self.config, self.total = self.trainer.config, self.trainer.config.schedule.iterations
        self._first, self._pace, self._stopped = self.iteration, 0.0, False
        self._interrupted = threading.Event()
        self._run: Run | None = None
        self._evidence: Evidence | None = None
        self._writer = make_writer and make_writer(str(self.folder.tensorboard))
        self._evaluate_at = {self.config.scaled(n) for n in self.config.schedule.evaluate_at} | {self.total}
        self._checkpoint_every = self.config.scaled(self.config.schedule.checkpoint_every)
        response, count = self.trainer.field.response, self.trainer.field.gaussians.count
        log.info("response %s, %d Gaussians on %s", response.name, count, self.device)
        for line in (*response.notes, *self._crowded(), *told_of_ranks(scene, self.trainer)):
            log.info("%s", line)

    @property
    def iteration(self) -> int:
        """Steps done."""
        return self.trainer.iteration

    @property
    def run(self) -> Run:
        """The trained scene, from the newest checkpoint."""
        self._run = self._run or load_run(self.folder.path, device=self.device)
        return self._run

    @property
    def ending(self) -> bool:
        """Whether no further step is made: the training was stopped or interrupted."""
        return self._stopped or self._interrupted.is_set()

    def render(self, camera: Camera) -> RenderedView:
        """What the scene shows now from a camera, in Rec.709, between steps; its time is not the training's."""
        return as_rec709(self.trainer.render(camera), self.scene.color_matrix, self.trainer.field.base_time)

    def stop(self) -> None:
        """Ends the training after the step that is being made."""
        self._stopped = True

    def timed(self, function: Callable):
        """What a function returns; its time, and what the device had left to do, count as the training's."""
        started = time.perf_counter()
        try:
            return function()
        finally:
            self.seconds += time.perf_counter() - started

    def __iter__(self) -> Iterator[Step]:
        with (
            oom_context(self.device, lambda: sizes_of(self.scene, self.trainer.field.gaussians.count), TRAINING_REMEDY),
            torch_settings(self.config.deterministic),
            interruptible() as interrupted,
            ExitStack() as leaving,
        ):
            self.folder.lock()
            leaving.callback(self.folder.unlock)
            self._interrupted = interrupted
            try:
                while self._goes_on():
                    yield self._step()
            except GeneratorExit:
                self.stop()
                self._goes_on()
                self._save()
                raise
            self._save()
            if interrupted.is_set() and self.iteration < self.total:
                log.info("stopped at iteration %d; continue with --resume", self.iteration)
                return
            self._run = None
            run = self.run
            evidence = run.measure_confidence(self.scene) if self._evidence is None else self._evidence
            run.model.confidence = evidence.confidence()
            write_confidence(self.folder, evidence, run.checkpoint_hash)
            self._tell_unexplained(run)

    def pause(self) -> None:
        """Between steps: keeps other ranks waiting for a next one. To be called now and then."""
        if self.ranks is not None and self.ranks.agree(WAIT) == END:
            self.stop()

    def _goes_on(self) -> bool:
        """Whether there is a next step; of several ranks any may end the training."""
        wanted = self.iteration < self.total and not self.ending
        if self.ranks is None:
            return wanted
        while (agreed := self.ranks.agree(GO if wanted else END)) == WAIT:
            pass
        return agreed == GO

    def _step(self) -> Step:
        before, first = self.seconds, self.iteration + 1
        self.timed(self.trainer.step)
        iteration, photos = self.iteration, self.trainer.photos
        evaluate = not self._evaluate_at.isdisjoint(range(first, iteration + 1))
        save = self.trainer.came_to(self._checkpoint_every)
        if evaluate or save:
            self._wait()
        if evaluate and self.scene.test_views:
            self._evaluate()
        if save:
            self.trainer.settle()
        if save and iteration < self.total:
            self._checkpoint()
        step = Step(self)
        if self._writer is not None and self.trainer.came_to(max(1, self.total // 200)):
            self._log("train", {name: getattr(step, name) for name in ("loss", "psnr", "gaussians")})
        done = iteration - self._first - photos
        if done == 0:  # It compiled kernels, which says nothing of the pace.
            return step
        self._pace += ((self.seconds - before) / photos - self._pace) / min(done, 100)
        # With all the Gaussians that it may have, a step takes about twice as long as at the start.
        strategy = self.trainer.densification
        growing = self.trainer.field.gaussians.count < strategy.most
        ahead = max(0.0, 1 - iteration / strategy.stop) if growing else 0.0
        step.seconds_left = self._pace * (1 + ahead) * (self.total - iteration)
        return step

    def _wait(self) -> None:
        """Lets the device finish, as part of the training's time."""
        if self.device.type == "cuda":
            self.timed(lambda: torch.cuda.synchronize(self.device))

    def _save(self) -> None:
        """The end of this process's part: a checkpoint, a summary, and what the held-out photos say of the whole."""
        self._wait()
        self.trainer.settle()
        self.trainer.check()
        if self.iteration >= self.total and self.iteration > self._first:
            self._evidence = self._remove_unseen()
        self._checkpoint()
        if self.ranks is not None:
            self.ranks.part()
        trainer, decisions = self.trainer, self.folder.read_decisions()
        summary = {
            "iteration": trainer.iteration,
            "finished": trainer.iteration >= self.total,
            "plan": {decision["name"]: decision["choice"] for decision in decisions} or None,
            "train_seconds": round(self.seconds, 3),
            "gaussians": trainer.field.gaussians.count,
            "skipped_steps": trainer.skipped_steps,
            "steps_without_room": trainer.steps_without_room,
        }
        self.folder.write_summary(summary | machine_figures(self.device))
        warn_of_overfitting(self.folder.read_metrics())
        if self._writer is not None:
            self._writer.close()

    def _remove_unseen(self) -> Evidence:
        """Remove the Gaussians that no training photo shows; return what the photos say of the others."""
        trainer, views = self.trainer, self.scene.train_views
        truth = self.config.loss.uses_hdr
        evidence = gather_evidence(trainer.field, views, degree=trainer.degree, truth=truth)
        count, contributes = trainer.field.gaussians.count, evidence.contributes
        remaining = int(contributes.sum())
        if remaining == count or remaining == 0:
            return evidence
        trainer.field.gaussians.keep(contributes, trainer.optimizer)
        log.info("removed %d of %d Gaussians, which no training photo shows", count - remaining, count)
        return evidence.rows(contributes)

    def _tell_unexplained(self, run: Run) -> None:
        """Compares the training photos with the scene, and names what is missing in the summary and in a line."""
        regions = find_residual_regions(run.model, self.scene.train_views, degree=run.degree)
        self.folder.write_summary(run.summary() | {"unexplained": regions_to_dict(regions)})
        if regions:
            worst, photos = regions[0], len({region.photo for region in regions})
            log.warning(
                "%d regions in %d photos are not explained by the scene; the worst: %s at column %.0f, row %.0f, "
                "%d pixels %.1f stops %s than the photo (summary.json names %d)",
                *(len(regions), photos, worst.photo, worst.column, worst.row, worst.pixels, abs(worst.stops)),
                *("darker" if worst.stops > 0 else "brighter", min(len(regions), MAX_LISTED)),
            )

    def _evaluate(self) -> None:
        scores = evaluate_views(self.trainer.field, self.scene.test_views, self.trainer.degree)
        line = {"iteration": self.iteration, "seconds": round(self.seconds, 3), "split": "test"}
        line |= {name: round(value, 4) for name, value in scores.items()}
        self.folder.append_metrics(line | {"gaussians": self.trainer.field.gaussians.count})
        self._log("test", scores)
        log.info("iteration %d: %s, after %.1f s", self.iteration, format_scores(scores), self.seconds)

    def _checkpoint(self) -> None:
        """Saves the state, unless the training has diverged: the last good checkpoint then stays the newest."""
        tensors, values = self.trainer.state()
        if (name := first_not_finite(tensors)) is not None:
            raise SehdrError(
                f"iteration {self.iteration}: {name} is not finite and was not saved; --resume goes back to the last "
                "good checkpoint; if it happens again, lower the learning rates or check photos and cameras"
            )
        if self.iteration > self._first and not math.isfinite(loss := self.trainer.loss):
            told = "iteration %d: the loss is %s; no checkpoint is written, the last one stays"
            log.warning(told, self.iteration, loss)
        else:
            kept = self.config.schedule.keep_checkpoints
            self.folder.write_checkpoint(tensors, values | {"seconds": self.seconds}, kept=kept)

    def _log(self, split: str, figures: dict[str, float]) -> None:
        if self._writer is not None:
            for name, value in figures.items():
                self._writer.add_scalar(f"{split}/{name}", value, self.iteration)

    def _begin(self, scene: Scene, config: Config, data: dict, overwrite: bool) -> Trainer:
        normalized = normalization_of(scene).scene(scene)
        config, plan = apply_plan(normalized, config, self.device)
        check_truth(scene.name, [(view.name, view.hdr is not None) for view in scene.train_views], config.loss)
        response = choose_response(scene, config)
        matcher, gains = cache(partial(make_matcher, normalized, response, self.device)), None
        if plan is not None and estimates_compensation(scene, config, response):
            found = self.timed(partial(estimate_compensation, normalized, config, response, self.device))
            gains, matcher, plan = found.gains, (lambda: found.matcher), plan.with_decision(found.decision)
        evened = self._even(scene, gains, response)
        field = self.timed(partial(make_field, evened, config, response, self.device, matcher))
        trainer = Trainer(evened, config, field, matcher, self.ranks)
        # Nothing is made or removed before the scene is known to be good.
        tensors, values = trainer.state()
        state = tensors, values | {"seconds": self.seconds}
        given = scene, config, trainer.field, data, plan and plan.to_dict(), state
        self.folder.begin(*given, gains=gains, overwrite=overwrite)
        for line in plan.lines() if plan is not None else ():
            log.info("%s", line)
        return trainer

    def _even(self, scene: Scene, gains: ExposureCompensation | None, response: Response) -> Scene:
        """The scene that is trained on from here."""
        self.scene = scene if gains is None else gains.normalize_photos(scene, response)
        return self.scene

    def _continue(self, config: Config | None) -> Trainer:
        """The trainer as the newest checkpoint has it."""
        folder, scene = self.folder, self.scene
        folder.lock()
        info, saved = folder.read_info(), folder.read_config()
        if config is not None and config.plan.enabled:
            # As it was planned then: on another machine the same config may be planned otherwise.
            fields = {path: value for made in folder.read_decisions() for path, value in made["fields"].items()}
            config = override_config(config, fields | {"plan.enabled": False})
        for path, _ in config_fields() if config is not None else ():
            old, new = attrgetter(path)(saved), attrgetter(path)(config)
            if old != new:
                problem = f"{path} = {old!r}, but {new!r} was asked for"
                raise InputError(folder.config, problem, "resume with the run's own config, or train anew")
        folder.check_same_scene(scene)
        checkpoint = folder.newest_checkpoint()
        if checkpoint is None:
            raise InputError(folder.checkpoints, "holds no complete checkpoint", "train again, with --overwrite")
        field = field_from_checkpoint(checkpoint, saved, info).to(self.device)
        trainer = Trainer(self._even(scene, photo_gains(info), field.response), saved, field, ranks=self.ranks)
        try:
            trainer.load_state(checkpoint.tensors, checkpoint.values)
        except (LookupError, TypeError, ValueError, RuntimeError, AttributeError, OverflowError) as error:
            problem = f"its state cannot be taken up ({error!r:.120})"
            raise InputError(checkpoint.path, problem, "remove it, or train again") from None
        folder.rewind_metrics(trainer.iteration)
        self.seconds = checkpoint.values["seconds"]
        return trainer

    def _crowded(self) -> Iterator[str]:
        """What to know of a training with more start points than it may have, or may add to."""
        count, budget = self.trainer.field.gaussians.count, self.trainer.densification.most
        points, most = len(self.scene.points), self.config.densification.cap_max
        if self.iteration == 0 and points > most:
            yield f"{points} start points: drawn from, for densification.cap_max = {most}"
        if count > budget:
            yield (
                f"{count} Gaussians are more than the cap of {budget} for these photos: they are relocated, and "
                "none are added; mcmc.cap_density=0 lets them grow to densification.cap_max"
            )


def train(
    scene: Scene, out: Path | str, config: Config | str | Path | Mapping[str, Any] | None = None, **options: Any
) -> Run:
    """Trains a scene to the end; returns the trained run.

    Args:
        scene: of load_scene.
        out: the folder of the run.
        config: as of Training.
        options: the other arguments of Training, whose errors are raised.
    """
    training = Training(scene, out, config, **options)
    for _ in training:
        pass
    return training.run
