"""The trainer: the loop of a training, and the step that it repeats.

Read `Trainer.__iter__` for the loop and `Trainer.step` for a step: forward, loss, backward, optimizer step,
densification, moving average. training_state.py has what a training consists of, train.py creates trainers, and
run_output.py evaluates, logs and saves.
"""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial

from torch import Tensor

from ..model.radiance_field import RadianceField, RenderedView
from ..rasterizer import HarmonicsGradients
from ..rasterizer.memory import TRAINING_REMEDY, oom_context
from ..rasterizer.tile_lists import MAX_SINGLE_SORT
from ..rasterizer.training_step import differentiate
from ..response.learned import EXACT_BELOW
from ..runs.config import Config
from ..runs.run import Run, as_rec709
from ..scene import Camera, Scene
from .initialization import sizes_of
from .losses import data_loss, extra_images, with_opacity_penalty
from .machine import interruptible, torch_settings
from .matching import Matcher, seed_gaussians
from .optimizer import guarded_step, means_rate, set_means_rate
from .photo_stream import PhotoStream
from .ranks import END, GO, WAIT, Ranks
from .run_output import RunOutput
from .strategies import SEED_STRIDE, Proposals
from .targets import TrainingView, ViewStack
from .training_state import Gradients, StepResult, TrainingState

log = logging.getLogger(__name__)

CHECK_EVERY = 20  # Iterations between checks of the counts that steps keep on the device
COMPARE_EVERY = 500  # Iterations between checks that all ranks have the same Gaussians


class Step:
    """Values of a training after a step.

    `loss`, `psnr` and `gaussians` are read from the device when they are accessed, until the next step.

    Attributes:
        iteration: Iterations done.
        total: Iterations in all.
        seconds: Duration of the training so far.
        seconds_left: Estimated time to the end; None after the first step.
    """

    def __init__(self, trainer: TrainingState):
        """Take the values of a trainer after a step."""
        self._trainer = trainer
        self.iteration, self.total, self.seconds = trainer.iteration, trainer.total, trainer.seconds
        self.seconds_left: float | None = None

    def __repr__(self) -> str:
        """Return iteration and time; nothing is read from the device."""
        return f"Step({self.iteration} of {self.total}, {self.seconds:.1f} s)"

    @property
    def loss(self) -> float:
        """Loss of the step."""
        return self._trainer.timed(lambda: self._trainer.loss)

    @property
    def psnr(self) -> float:
        """PSNR of the step's photo, dB."""
        return self._trainer.timed(self._trainer.psnr)

    @property
    def gaussians(self) -> int:
        """Number of Gaussians."""
        return self._trainer.field.gaussians.count


class Trainer(TrainingState):
    """Trains the radiance field of a scene.

        trainer = create_trainer(scene, "run", "fast")
        for step in trainer:
            if step.iteration % 100 == 0:
                print(step.iteration, step.psnr, step.seconds_left)
        run = trainer.run

    Leaving the loop, or stop(), ends the training: a checkpoint is written, from which it can be resumed. While the
    loop runs, torch uses one thread, and the first SIGINT, SIGTERM or SIGHUP ends the training after a step: it takes
    effect (KeyboardInterrupt) once the checkpoint is written. Until then no other training may use the folder.

    Attributes, beside those of TrainingState:
        output: Run folder to evaluate, log and save to; None to save nothing.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        field: RadianceField,
        *,
        matcher: Callable[[], Matcher] | None = None,
        ranks: Ranks | None = None,
        output: RunOutput | None = None,
    ):
        """Prepare a training; create_trainer() does this for a scene and a run folder.

        Args:
            scene: Scene with at least two training views.
            config: Options of the training, after the plan.
            field: Field at iteration 0, on the device to train on.
            matcher: Creates the matcher of the training photos that seeding uses.
            ranks: Processes that train together.
            output: Run folder to evaluate, log and save to; None to save nothing.
        """
        super().__init__(scene, config, field, matcher, ranks)
        self.output = output
        self.interrupted, self._stopped = threading.Event(), False
        self._pace = 0.0  # Seconds per iteration, smoothed

    # The loop

    def train(self) -> Run:
        """Train to the end and return the trained run."""
        for _ in self:
            pass
        return self.run

    def __iter__(self) -> Iterator[Step]:
        """Train step by step; yield after each step, after evaluation and checkpoint if they are due."""
        with self._session():
            try:
                while self._agree_to_continue():
                    started = self.seconds
                    self.timed(self.step)
                    if self.output is not None:
                        self.output.after_step(self)
                    yield self._step(started)
            except GeneratorExit:  # The caller left the loop.
                self.stop()
                self._agree_to_continue()
                self._finish(complete=False)
                raise
            if self.iteration < self.total and self.output is not None:
                log.info("stopped at iteration %d; continue with --resume", self.iteration)
            self._finish(complete=self.iteration >= self.total)

    @contextmanager
    def _session(self) -> Iterator[None]:
        """Apply the process settings of a training: out-of-memory errors, torch's threads, signals, folder lock."""
        with (
            oom_context(self.device, lambda: sizes_of(self.scene, self.field.gaussians.count), TRAINING_REMEDY),
            torch_settings(self.config.deterministic),
            interruptible() as self.interrupted,
            ExitStack() as leaving,
        ):
            if self.output is not None:
                self.output.folder.lock()
                leaving.callback(self.output.folder.unlock)
            yield

    def _agree_to_continue(self) -> bool:
        """Return whether there is a next step; any rank may end the training."""
        remains = self.iteration < self.total and not self.ending
        if self.ranks is None:
            return remains
        while (agreed := self.ranks.all_reduce_min(GO if remains else END)) == WAIT:
            pass
        return agreed == GO

    def _finish(self, *, complete: bool) -> None:
        """Save the end of the training; if complete, also the confidence and the residual regions."""
        self.synchronize()
        self.gather()
        self.check()
        if self.output is not None:
            self.output.finish(self, complete=complete)
        elif self.ranks is not None:
            self.ranks.shutdown()

    def _step(self, started: float) -> Step:
        """Return the values of the last step, with the time left."""
        step, steps_before = Step(self), self.iteration - self.first_iteration - self.step_batch
        if steps_before == 0:  # The first step compiles kernels and says nothing of the pace.
            return step
        self._pace += ((self.seconds - started) / self.step_batch - self._pace) / min(steps_before, 100)
        # With the largest number of Gaussians, a step takes about twice as long as at the start.
        growing = self.field.gaussians.count < self.strategy.cap_max
        ahead = max(0.0, 1 - self.iteration / self.strategy.schedule.stop) if growing else 0.0
        step.seconds_left = self._pace * (1 + ahead) * (self.total - self.iteration)
        return step

    # One step

    def step(self) -> None:
        """Train one step, on one photo per rank.

        Raises:
            SehdrError: If more than MAX_SKIPPED steps were not finite, or ranks differ.
        """
        # The last step may have more photos than iterations are left.
        self.step_batch = min(self.batch, max(1, self.total - self.iteration))
        self.iteration += self.step_batch
        views, gaussians = self._training_views(), self.field.gaussians
        index = self._view_index = self.order.next()
        means_lr = means_rate(self.config, self.extent, self.iteration, self.batch)
        set_means_rate(self.optimizer, means_lr)
        if self.reserves_rows and not self._rows:
            self._reserve_rows()
        needs_means2d_grad = self.strategy.needs_gradients(self.iteration)
        if needs_means2d_grad:
            self.strategy.prepare(gaussians.reserved, self.device)

        # Forward, loss, backward, optimizer step; as a CUDA graph if a step with this key has been launched before.
        # Small counts use other kernels: a sort in a single pass, and an exact learned response.
        small = gaussians.reserved < EXACT_BELOW, gaussians.reserved <= MAX_SINGLE_SORT
        graph_key = (self.degree, needs_means2d_grad, self.opacity_weight > 0, *small)
        # Display colors are rendered at the photo's exposure by a branch of the host, so that time must be a number.
        fixed_time = not self.field.color_model.encoded or isinstance(getattr(views, "times", None), float)
        if fixed_time and self.graphs.can_capture(views, graph_key, has_counts=self.capacity.has_counts):
            self._index.fill_(index)
            if isinstance(views, PhotoStream):
                views.bring(index)
            capacity = self.capacity.capacity()
            compute = partial(self._compute_at_index, views, needs_means2d_grad, capacity)
            self._result = self.graphs.run(graph_key, self._optimize, compute, self.apply_gradients, self.iteration)
            if isinstance(views, PhotoStream):
                views.release(self.order.peek())
        else:
            compute = partial(self.compute_gradients, views[index], needs_means2d_grad)
            with self.graphs.on_capture_stream():
                self._result = self._optimize(compute, self.apply_gradients)

        # Densification.
        self.strategy.inject_noise(self.iteration, gaussians, means_lr)
        self._densify()
        # Moving average.
        self.average.update(self.iteration, self.step_batch, gaussians)
        if self.came_to(CHECK_EVERY):
            self.check(wait=False)
        if self.came_to(COMPARE_EVERY):
            self.gather()

    def _optimize(self, compute: Callable[[], Gradients], apply: Callable[[Gradients], Tensor]) -> StepResult:
        """Compute gradients, average them over the ranks, and apply them."""
        with self.field.gaussians.all_rows(self.optimizer):
            if self.ranks is not None:
                self._flat_gradients()  # Allocated here, not in the memory of a CUDA graph.
            gradients = compute()
            if self.ranks is not None and self._flat is not None:
                self.ranks.all_reduce_mean(self._flat.buffer)
            return StepResult(apply(gradients), gradients.image)

    def _compute_at_index(self, views: ViewStack | PhotoStream, needs_means2d_grad: bool, capacity: int) -> Gradients:
        """Compute gradients of the view whose index is on the device, with a fixed intersection capacity."""
        return self.compute_gradients(views.at(self._index), needs_means2d_grad, capacity)

    def compute_gradients(
        self, view: TrainingView, needs_means2d_grad: bool, max_intersections: int | None = None
    ) -> Gradients:
        """Render a view, compute the loss and differentiate it.

        Args:
            view: The training view.
            needs_means2d_grad: Whether the strategy needs the gradients of the projected means.
            max_intersections: Fixed capacity, with which nothing waits for the device.
        """
        target, camera, field, config = view.target, view.camera, self.field, self.config.loss
        render = field.render_train_view(
            camera,
            view.exposure_time,
            degree=self.degree,
            also=extra_images(config, target.exposure_truth is not None),
            max_intersections=max_intersections,
            encode=self._encoded,
            factored=self.factored,
            opacity_weight=self.opacity_weight,
        )
        # Drop references to tensors that the backward pass does not need, so that their memory is reused in the step.
        dropped = {"image", "transmittance", "depths"} | (set() if needs_means2d_grad else {"means2d", "extents"})
        rendering = replace(render.rendering, **dict.fromkeys(dropped))
        if needs_means2d_grad:
            rendering.means2d.retain_grad()
        loss = with_opacity_penalty(data_loss(field, render, target, config, self._largest_truth), render)
        image = render.encoded if self._encoded else render.photo_exposure
        harmonics_gradients = render.harmonics_gradients
        assert image is not None
        del render, target, view
        differentiate(loss)
        harmonics = None
        if self.factored:
            values = harmonics_gradients[0].contiguous()
            harmonics = HarmonicsGradients(values[None], camera.position[None], field.gaussians.means, self.degree)
        if self.ranks is not None:
            self._flat_gradients().collect(loss, rendering.overflow, harmonics)
        return Gradients(loss.detach(), image.detach(), rendering, needs_means2d_grad, harmonics)

    def apply_gradients(self, gradients: Gradients) -> Tensor:
        """Update the parameters, unless the step is not finite; return its loss. Does not wait for the device."""
        rendering, loss, harmonics = gradients.rendering, gradients.loss, gradients.harmonics
        incomplete = rendering.overflow
        if self._flat is not None:
            loss, incomplete, harmonics = self._flat.distribute()
        applied = guarded_step(
            self.optimizer,
            loss,
            incomplete,
            harmonics,
            step_counters=self.capacity.step_counters,
            intersections=rendering.needed_intersections,
            active_count=self.field.gaussians.active_count,
        )
        if gradients.needs_means2d_grad:
            height, width, _ = gradients.image.shape
            self.strategy.accumulate(rendering, width, height, applied)
        self.optimizer.zero_grad()
        if rendering.needed_intersections is None:
            self.capacity.observe(rendering.intersection_count)
        return loss

    def _densify(self) -> None:
        """Refine the Gaussians if that is due; on several ranks, rank 0 does and the others receive the result."""
        gaussians, strategy, ranks = self.field.gaussians, self.strategy, self.ranks
        if not strategy.is_due(self.iteration, self.step_batch):
            return
        count, reallocations = gaussians.count, gaussians.reallocations
        propose = self._propose_gaussians if self.can_seed else None
        randomness, photos = self.generator, self.step_batch
        refine = partial(strategy.refine, self.iteration, gaussians, self.optimizer, randomness, propose, photos)
        changed = refine() if ranks is None else ranks.refine_on_leader(refine, strategy, gaussians, self.optimizer)
        if changed and self.reserves_rows:
            self._reserve_rows()
        if changed and self.graphs.enabled:
            valid = self.capacity.rescale(
                gaussians.count / max(1, count), keep=gaussians.reallocations == reallocations
            )
            if not valid:
                self.graphs.invalidate()

    def _propose_gaussians(self, number: Tensor, bound: int) -> Proposals:
        """Propose new Gaussians where the step's photo is reproduced worst; the same in a resumed training."""
        random_seed = self.config.seed * SEED_STRIDE + self.iteration
        view, result = self._training_views()[self._view_index], self._result
        assert result is not None
        with self.graphs.on_capture_stream():
            rendered = result.image if self._encoded else self.field.response.encode_extended(result.image)
            return seed_gaussians(
                self.field, self._matcher(), rendered, view, self._view_index, number, bound, random_seed
            )

    # Between steps

    @property
    def opacity_weight(self) -> float:
        """Weight of the mean opacity in this step: 0 once no refinement follows."""
        return 0.0 if self.strategy.schedule.is_over(self.iteration) else self.config.loss.opacity_weight

    @property
    def run(self) -> Run:
        """The trained run, from the newest checkpoint."""
        assert self.output is not None, "this trainer saves no run"
        return self.output.load_run(self.device)

    @property
    def ending(self) -> bool:
        """True if no further step follows: the training was stopped or interrupted."""
        return self._stopped or self.interrupted.is_set()

    def stop(self) -> None:
        """End the training after the current step."""
        self._stopped = True

    def pause(self) -> None:
        """Keep other ranks waiting for the next step; call it now and then between steps."""
        if self.ranks is not None and self.ranks.all_reduce_min(WAIT) == END:
            self.stop()

    def render(self, camera: Camera) -> RenderedView:
        """Render the scene as it is now in linear Rec.709; does not count as time of the training."""
        with self.graphs.on_capture_stream():
            view = self.field.render(camera, degree=self.degree)
        return as_rec709(view, self.scene.color_matrix, self.field.base_time)
