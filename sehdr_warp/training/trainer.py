"""The trainer: the loop of a training, and the step that it repeats.

Read `Trainer.__iter__` for the loop and `Trainer.step` for a step: gradient step, densification, moving average. The
gradient step (forward, loss, backward, optimizer) is in gradient_step.py; run_output.py evaluates, logs and saves, and
training_state.py lists what a checkpoint holds. On several ranks, each runs this loop; only rank 0 has an output.

Trainer.step() -> StepRunner.run() -> GradientStep.run(). Its compute_gradients() calls
RadianceField.render_photo() -> spherical_harmonics() (kernels harmonics) and rasterize() (kernels project, tiles,
blend_cuda or blend_cpu), then data_loss() and differentiate(); its apply_gradients() calls decide_step() -> Adam.step()
(on a GPU, kernels step_updates). On a GPU, StepRunner.run() captures it as a CUDA graph; a replay repeats its kernels.
Before the first step, create_trainer() matches points between photos (kernels plane_sweep), makes the Gaussians, and
writes the checkpoint of iteration 0.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache, partial
from operator import attrgetter

import torch
from torch import Tensor

from ..errors import InputError, SehdrError
from ..model.color_models import rec709_of
from ..model.pixel_filter import need_rays
from ..model.radiance_field import RadianceField
from ..model.renders import RenderedView
from ..rasterizer.memory import TRAINING_REMEDY, oom_context
from ..runs.config import Config
from ..runs.run import Run
from ..scene import Camera, Scene
from .advice import best_if_overfitted, evaluations
from .data_manager import DataManager, PhotoSampler
from .gradient_step import OVERFLOWED, SKIPPED, GradientStep, StepResult
from .initialization import depth_of_points, make_matcher
from .matching import Matcher
from .measured_light import replace_measured
from .moving_average import MovingAverage
from .optimizer import make_optimizer, means_rate, set_means_rate
from .process_settings import interruptible, torch_settings
from .ranks import END, GO, WAIT, Ranks
from .run_output import RunOutput
from .scene_facts import PointFacts, is_large
from .seeding import make_seeds
from .sharpness import missing_sharpness
from .step_runner import StepRunner
from .strategies import SEED_STRIDE, Seeds, make_strategy
from .training_progress import TrainingProgress

log = logging.getLogger(__name__)

CHECK_EVERY = 20  # Iterations between checks of the counts that steps keep on the device
COMPARE_EVERY = 500  # Iterations between checks that all ranks have the same Gaussians
MAX_SKIPPED = 20  # More steps than this with a loss or gradient that is not finite end the training


class Trainer:
    """Trains the radiance field of a scene.

        trainer = create_trainer(scene, "run", "fast")
        for progress in trainer:
            if progress.iteration % 100 == 0:
                print(progress.iteration, progress.psnr, progress.seconds_left)
        run = trainer.run

    Leaving the loop, or stop(), ends the training: a checkpoint is written, from which it can be resumed. While the
    loop runs, torch uses one thread, and the first SIGINT, SIGTERM or SIGHUP ends the training after a step: it takes
    effect (KeyboardInterrupt) once the checkpoint is written. Until then no other training may use the folder.

    Attributes:
        scene: The scene, with compensated photos.
        config: Options of the training.
        field: The radiance field that is trained.
        output: Run folder to evaluate, log and save to, which create_trainer() sets; None to save nothing.
        optimizer: Adam, over the field's parameters.
        strategy: The densification strategy.
        average: Moving average of the Gaussians.
        iteration: Iterations done; a step on several ranks counts one for each photo.
        first_iteration: Iterations done before this process.
        total: Iterations in all.
        large_scene: Whether photos show little of the scene, see scene_facts.is_large().
        median_depth: Depth around which photos are matched, see depth_of_points().
        batch: Photos of a step, one for each rank; each counts as an iteration.
        step_batch: Photos of the last step: `batch`, or fewer if fewer iterations were left.
        seconds: Duration so far, without evaluation, renders for figures that are shown, and checkpoints.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        field: RadianceField,
        *,
        get_matcher: Callable[[], Matcher] | None = None,
        ranks: Ranks | None = None,
        point_facts: PointFacts = PointFacts(),
    ):
        """Prepare a training on the device of the field; create_trainer() does this for a scene and a run folder.

        `config` is that after the plan. get_matcher() returns the matcher of the training photos that seeding uses,
        by default a new one. `ranks` train together. point_facts are those of a training that goes on, whose
        scene may lack points; by default those of the scene.
        """
        self.scene, self.config, self.field, self.ranks = scene, config, field, ranks
        self.output: RunOutput | None = None
        rank, self.batch = (0, 1) if ranks is None else (ranks.rank, ranks.count)
        self.device, self.total = field.gaussians.means.device, config.schedule.iterations
        self.iteration, self.first_iteration, self.step_batch, self.seconds = 0, 0, 1, 0.0
        normalized = field.normalization.scene(scene)
        views = normalized.train_views
        self.optimizer = make_optimizer(field, config, self.batch)
        pixels = sum(view.camera.pixel_count for view in views)
        self.large_scene = is_large(scene) if point_facts.large_scene is None else point_facts.large_scene
        self.strategy = make_strategy(config, pixels, large_scene=self.large_scene)
        self.average = MovingAverage(config, self.strategy.schedule.stop)
        self.sampler = PhotoSampler(len(views), config.seed, rank, self.batch)
        self.generator = torch.Generator(device=self.device).manual_seed(config.seed)
        # Projected centers, which "adc" needs, and seeding are for pinhole photos alone.
        wide = next((view for view in views if not view.camera.is_pinhole), None)
        if wide is not None and config.densification.strategy == "adc":
            problem = f"view {wide.name} is {wide.camera.projection}, for which densification.strategy = 'adc' has no "
            raise InputError(scene.name, f"{problem}projected centers", "use densification.strategy=mcmc")
        self._can_seed = wide is None
        field.along_rays = need_rays([view.camera for view in views])
        self.median_depth = point_facts.median_depth or depth_of_points(normalized)
        own_matcher = cache(partial(make_matcher, normalized, field.response, self.device, self.median_depth))
        self._get_matcher: Callable[[], Matcher] | None = get_matcher or own_matcher  # None after the last refinement

        field.gaussians.release()  # Another trainer of this field may have reserved rows for its own optimizer.
        self.gradient_step = GradientStep(scene, config, field, self.optimizer, self.strategy, ranks, self.large_scene)
        use_cuda_graph = config.schedule.use_cuda_graph  # If the device can; how photos are stored depends on it.
        self.step_runner = StepRunner(self.gradient_step, enabled=use_cuda_graph, deterministic=config.deterministic)
        self.data_manager = DataManager(views, field, config, use_cuda_graph=self.step_runner.enabled)
        self._result: StepResult | None = None  # Of the last step
        self._view_index = 0  # Training view of the last step
        # Why no further step follows: a signal, stop(), another rank that has ended
        self.interrupted, self._stopped, self._ranks_ended = threading.Event(), False, False
        self._finished = False  # Whether the training came to its end, and its results are written
        self._seconds_per_iteration = 0.0  # Running mean

    # The loop

    def train(self) -> Run:
        """Train to the end and return the trained run; warn if held-out photos were better before."""
        for _ in self:
            pass
        scores = evaluations(self.run.metrics())
        if best := best_if_overfitted(scores):
            message = "held-out photos scored best at iteration %d (%.2f dB), now %.2f dB: train fewer iterations"
            log.warning(message, best.iteration, best.psnr, scores[-1].psnr)
        return self.run

    def __iter__(self) -> Iterator[TrainingProgress]:
        """Train step by step; yield after each step, after evaluation and checkpoint if they are due."""
        if self._finished:
            return
        with self._session():
            try:
                while self._agree_to_continue():
                    before = self.seconds
                    with self._timed():
                        self.step()
                    if self.output is not None:  # Evaluation, checkpoint, log.
                        self.output.after_step(self)
                    yield TrainingProgress(self, self._estimate_seconds_left(self.seconds - before))
            except GeneratorExit:  # The caller left the loop.
                self.stop()
                self._agree_to_continue()
                self._finish()
                raise
            if self.iteration < self.total and self.output is not None:
                log.info("stopped at iteration %d; continue with --resume", self.iteration)
            self._finish()

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
        """Return whether there is a next step. Any rank may end the training, and rank 0 may make the others wait."""
        signal = END if self._ranks_ended else WAIT
        while signal == WAIT:
            signal = GO if self.iteration < self.total and not self.ending else END
            if self.ranks is not None:
                signal = self.ranks.all_reduce_min(signal)
        return signal == GO

    def _estimate_seconds_left(self, step_seconds: float) -> float | None:
        """Return the estimated time to the end after a step; None after the first, because that compiles kernels."""
        if (steps_before := self.iteration - self.first_iteration - self.step_batch) == 0:
            return None
        change = step_seconds / self.step_batch - self._seconds_per_iteration
        self._seconds_per_iteration += change / min(steps_before, 100)
        # With the largest number of Gaussians, a step takes about twice as long as at the start.
        growing = self.field.gaussians.count < self.strategy.cap_max
        growth = max(0.0, 1 - self.iteration / self.strategy.schedule.stop) if growing else 0.0
        return self._seconds_per_iteration * (1 + growth) * (self.total - self.iteration)

    def _finish(self) -> None:
        """Save the end of the training; after the last step, also measure the scene on the training photos."""
        self.synchronize()
        self.sync_ranks()
        self.check_skipped_steps()
        if self.output is not None:
            self.output.save_end(self)
        if self.ranks is not None:
            self.ranks.shutdown()
        if self.output is not None:
            self.output.write_results(self)
        self._finished = self.iteration >= self.total

    # One step

    def step(self) -> None:
        """Train one step, on one photo per rank.

        Raises:
            SehdrError: If more than MAX_SKIPPED steps were not finite, or ranks differ.
        """
        # Photo, learning rates and options. The last step may have more photos than iterations are left.
        self.step_batch = min(self.batch, max(1, self.total - self.iteration))
        self.iteration += self.step_batch
        self.data_manager.update_targets(self.iteration)
        replace_measured(self)
        self._view_index = self.sampler.next()
        means_lr = means_rate(self.config, self.iteration, self.batch)
        set_means_rate(self.optimizer, means_lr)
        options = self.gradient_step.options_at(self.iteration, self.degree)

        # Forward, loss, backward, optimizer step: GradientStep.run().
        views, next_index = self.data_manager.views, self.sampler.peek()
        self._result = self.step_runner.run(views, self._view_index, next_index, options, self.iteration)
        # Densification.
        self.strategy.inject_noise(self.iteration, self.field.gaussians, means_lr)
        if self.strategy.is_due(self.iteration, self.step_batch):
            self._densify()
        if not options.refines:
            self._get_matcher = None  # Its copies of the photos take memory on the device.
        # Moving average; after the last step, it replaces the Gaussians.
        self.average.update(self.iteration, self.step_batch, self.field.gaussians)
        # Checks; a checkpoint after this step holds what the ranks sum here.
        if self.passed_multiple_of(CHECK_EVERY):
            self.check_skipped_steps(wait=False)
        if self.passed_multiple_of(COMPARE_EVERY) or self.passed_multiple_of(self.config.checkpoint_interval):
            self.sync_ranks()

    def _densify(self) -> None:
        """Refine the Gaussians; on several ranks, rank 0 does and the others receive the result."""
        gaussians, strategy, ranks = self.field.gaussians, self.strategy, self.ranks
        count, reallocations = gaussians.count, gaussians.reallocations
        seeding = self._make_seeds if self._can_seed else None
        if ranks is not None:
            ranks.reduce_to_main(list(strategy.state_dict(count).values()))
        changed = (ranks is None or ranks.is_main_process) and strategy.refine(
            self.iteration, gaussians, self.optimizer, self.generator, seeding, self.step_batch, self._sharpness()
        )
        if ranks is not None:
            changed = ranks.broadcast_refined(changed, strategy, gaussians, self.optimizer)
        if changed:
            self.step_runner.after_densification(count, reallocations, self.iteration)

    def _make_seeds(self, number: Tensor, bound: int) -> Seeds:
        """Make new Gaussians where the step's photo is reproduced worst; the same in a resumed training."""
        view, result = self.data_manager.views[self._view_index], self._result
        assert result is not None and self._get_matcher is not None
        with self.step_runner.on_capture_stream():
            image = result.image
            if view.target.scale.compares_exposures:
                image = self.field.response.encode_extended(image)
            matcher, index = self._get_matcher(), self._view_index
            return make_seeds(self.field, matcher, image, view, index, number, bound, self._random_seed)

    def _sharpness(self) -> Tensor | None:
        """Return what photos show sharper than the scene, by Gaussian; None if the strategy does not use it."""
        number, views = self.strategy.sharpness_photos, self.data_manager.views
        with self.step_runner.on_capture_stream():
            seed, degree = self._random_seed, self.degree
            return missing_sharpness(self.field, views, number, seed, degree=degree) if number else None

    @property
    def _random_seed(self) -> int:
        """Seed of this iteration; the same in a resumed training."""
        return self.config.seed * SEED_STRIDE + self.iteration

    @property
    def degree(self) -> int:
        """SH degree of this iteration."""
        return self.config.degree_at(self.iteration)

    # Between steps

    def passed_multiple_of(self, every: int) -> bool:
        """Return whether the last step came to a multiple of a number of iterations, or past it."""
        return self.iteration % every < self.step_batch

    def check_skipped_steps(self, *, wait: bool = True) -> None:
        """Raise SehdrError if more than MAX_SKIPPED steps were not finite; the latest ones count if `wait`."""
        skipped = self.step_runner.poll(wait=wait)
        if skipped > MAX_SKIPPED:
            raise SehdrError(
                f"iteration {self.iteration}: {skipped} steps had a loss or gradient that is not finite, "
                f"more than {MAX_SKIPPED}; lower the learning rates or check photos and cameras"
            )

    def sync_ranks(self) -> None:
        """Sum statistics on rank 0 for a checkpoint; raise SehdrError if the ranks' Gaussians differ."""
        if self.ranks is not None:
            self.ranks.reduce_to_main(list(self.strategy.state_dict(self.field.gaussians.count).values()))
            self.ranks.check_equal(self.field.gaussians.tensors(), self.iteration)

    @contextmanager
    def _timed(self) -> Iterator[None]:
        """Count the time that a block takes on the host as time of the training."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds += time.perf_counter() - started

    def synchronize(self) -> None:
        """Wait for the device, as part of the training's time."""
        if self.device.type == "cuda":
            with self._timed():
                torch.cuda.synchronize(self.device)

    @property
    def loss(self) -> float:
        """Loss of the last step, read from the device; NaN before the first."""
        with self._timed():
            return float("nan") if self._result is None else float(self._result.loss)

    @torch.no_grad()
    def psnr(self) -> float:
        """Return the PSNR of the last step's photo inside the mask, dB; rendering it does not count as training."""
        self.synchronize()
        view = self.data_manager.views[self._view_index]
        with self.step_runner.on_capture_stream():
            photo = self.field.render_photo(view.camera, view.exposure_time, degree=self.degree).encoded
        assert photo is not None
        return view.target.psnr(photo)

    @property
    def skipped_steps(self) -> int:
        """Number of steps that were skipped because the loss or a gradient was not finite."""
        return int(self.gradient_step.step_counters[SKIPPED])

    @property
    def overflowed_steps(self) -> int:
        """Number of steps that were skipped because a CUDA graph had memory for fewer intersections."""
        return int(self.gradient_step.step_counters[OVERFLOWED])

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

    def keep_ranks_waiting(self) -> None:
        """Keep other ranks waiting for the next step; call it again and again during a long pause between steps."""
        if self.ranks is not None and self.ranks.all_reduce_min(WAIT) == END:
            self._ranks_ended = True
            self.stop()

    def render(self, camera: Camera) -> RenderedView:
        """Render the scene as it is now in linear Rec.709; does not count as time of the training."""
        with self.step_runner.on_capture_stream():
            view = self.field.render(camera, degree=self.degree)
        return replace(view, hdr=rec709_of(view.hdr, self.scene.color_matrix, self.field.white))


def sizes_of(scene: Scene, gaussians: int | None = None) -> tuple[int, int, int]:
    """Return the number of Gaussians, by default that of the points, and width and height of the largest photo."""
    camera = max((view.camera for view in scene.views), key=attrgetter("pixel_count"))
    return len(scene.points) if gaussians is None else gaussians, camera.width, camera.height
