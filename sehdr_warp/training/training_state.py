"""State of a training: scene, field, optimizer, strategy, random generators."""

import operator
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from ..errors import InputError, SehdrError
from ..model.radiance_field import RadianceField
from ..rasterizer import HarmonicsGradients, Rendering
from ..rasterizer.code_residual import CodeScale
from ..runs.checkpoint import under
from ..runs.config import Config
from ..runs.light_estimates import light_estimates
from ..scene import Scene
from .initialization import make_matcher, scene_extent
from .losses import INTERVALS_FROM, compares_exposures, largest_hdr_truth
from .matching import Matcher
from .optimizer import FlatGradients, MovingAverage, load_optimizer_tensors, make_optimizer, optimizer_tensors
from .photo_stream import PhotoStream, make_view_source
from .ranks import Ranks
from .step_graphs import GraphCapacity, StepGraphs
from .strategies import make_strategy
from .targets import TrainingView, ViewStack, photo_source

T = TypeVar("T")

MAX_RESERVE = 1.5  # Largest number of reserved rows as a multiple of the count; they cost memory and a little time
MAX_SKIPPED = 20  # More skipped steps than this end the training; a step is skipped if it is not finite


def has_wide_views(scene: Scene, config: Config) -> bool:
    """Return whether some training views are not pinholes.

    Raises:
        InputError: if there are, and the densification needs projected centers, which only pinholes have.
    """
    wide = next((view for view in scene.train_views if not view.camera.is_pinhole), None)
    if wide is not None and config.densification.strategy != "mcmc":
        problem = f"view {wide.name} is {wide.camera.projection}, for which densification.strategy = "
        problem += f"{config.densification.strategy!r} has no projected centers"
        raise InputError(scene.name, problem, "use densification.strategy=mcmc")
    return wide is not None


class PhotoOrder:
    """The order of `count` photos; all ranks draw the same order, and each takes its own photo of a step."""

    def __init__(self, count: int, seed: int, rank: int = 0, ranks: int = 1):
        """Create an order of `count` photos for process `rank` of `ranks`."""
        self._count, self._rank, self._ranks = count, rank, ranks
        self._remaining: list[int] = []
        self._generator = torch.Generator().manual_seed(seed)

    def next(self) -> int:
        """Return the index of this rank's next photo."""
        batch = []
        for _ in range(self._ranks):
            if not self._remaining:
                self._remaining = torch.randperm(self._count, generator=self._generator).tolist()
            batch.append(self._remaining.pop())
        return batch[self._rank]

    def peek(self) -> int | None:
        """Return what next() will return, or None if a new order has to be drawn first."""
        return self._remaining[-1 - self._rank] if self._rank < len(self._remaining) else None

    def state(self) -> tuple[Tensor, list[int]]:
        """Return the generator's state and the photos that remain of this order."""
        return self._generator.get_state(), list(self._remaining)

    def load_state(self, generator: Tensor, remaining: list) -> None:
        """Continue from state(); raises ValueError if it names photos that do not exist."""
        self._generator.set_state(generator.cpu())
        self._remaining = [operator.index(photo) for photo in remaining]
        if not all(0 <= photo < self._count for photo in self._remaining):
            raise ValueError(f"the order of the photos names others than the {self._count} there are")


@dataclass(frozen=True)
class Gradients:
    """Result of Trainer.compute_gradients, beside the gradients that the parameters hold.

    Attributes:
        loss: Scalar loss of this rank's photo.
        image: [H, W, 3] rendered image that was compared with the photo.
        rendering: Result of the rasterizer, without tensors that nothing reads any more.
        needs_means2d_grad: Whether the strategy accumulates the gradients of the projected means.
        harmonics: Gradients of the harmonics in factored form; None if the parameters hold them.
    """

    loss: Tensor
    image: Tensor
    rendering: Rendering
    needs_means2d_grad: bool
    harmonics: HarmonicsGradients | None


class StepResult(NamedTuple):
    """Loss of a step, mean over the ranks, and the image [H, W, 3] that was compared with this rank's photo."""

    loss: Tensor
    image: Tensor


class TrainingState:
    """Scene, field, optimizer, strategy and random generators of a training.

    state() contains everything that determines the next step: on the CPU a training that continues from it repeats an
    uninterrupted one bit for bit. No global random state is used.

    Attributes:
        scene: The scene, with compensated photos.
        config: Options of the training.
        field: The radiance field that is trained.
        optimizer: Adam, over the field's parameters.
        strategy: The densification strategy.
        average: Moving average of the Gaussians.
        iteration: Iterations done; a step on several ranks counts one for each photo.
        first_iteration: Iterations done before this process.
        total: Iterations in all.
        step_batch: Photos of the last step, one for each rank; each counts as an iteration.
        seconds: Duration so far, without evaluation and checkpoints.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        field: RadianceField,
        matcher: Callable[[], Matcher] | None,
        ranks: Ranks | None,
    ):
        """Create optimizer, strategy and generators; arguments as in Trainer."""
        self.scene, self.config, self.field, self.ranks = scene, config, field, ranks
        self.rank, self.batch = (0, 1) if ranks is None else (ranks.rank, ranks.count)
        self.device = field.gaussians.means.device
        self.total = config.schedule.iterations
        self.iteration, self.first_iteration, self.step_batch, self.seconds = 0, 0, 1, 0.0

        normalized = field.normalization.scene(scene)
        views = self._views = normalized.train_views
        self.extent = scene_extent(normalized)
        self.optimizer = make_optimizer(field, config, self.extent, self.batch)
        pixels = sum(view.camera.width * view.camera.height for view in views)
        positions = torch.tensor([view.camera.position.tolist() for view in views], device=self.device)
        self.strategy = make_strategy(config, self.extent, pixels, positions)
        self.average = MovingAverage(config, self.strategy.schedule.stop)
        self.order = PhotoOrder(len(views), config.seed, self.rank, self.batch)
        self.generator = torch.Generator(device=self.device).manual_seed(config.seed)
        self.can_seed = not has_wide_views(normalized, config)  # Seeding samples pixels of pinhole photos.
        self._matcher = matcher or cache(partial(make_matcher, normalized, field.response, self.device))

        # If exposures are compared, the loss does not need the encoded photo.
        self._encoded = not compares_exposures(config.loss, field)
        self._largest_truth = largest_hdr_truth(scene, config.loss) * field.base_time
        self._source: ViewStack | PhotoStream | Sequence[TrainingView] | None = None
        self._scale = CodeScale(torch.empty(0))
        self._widened = False
        self._result: StepResult | None = None
        self._view_index = 0

        self.graphs = StepGraphs(self.device, enabled=config.schedule.use_cuda_graph, several_ranks=ranks is not None)
        self.capacity = GraphCapacity(self.device)
        self._index = torch.zeros(1, dtype=torch.int64, device=self.device)
        # Captured steps run on reserved rows, so that the number of Gaussians can change without a new capture.
        self.reserves_rows, self._rows = self.graphs.enabled and not config.deterministic, 0
        field.gaussians.release()
        # On a GPU, gradients of the harmonics stay in factored form: they would be 48 numbers per Gaussian.
        self.factored = self.device.type == "cuda"
        self._flat: FlatGradients | None = None

    @property
    def degree(self) -> int:
        """SH degree of this iteration."""
        return self.config.degree_at(self.iteration)

    @property
    def loss(self) -> float:
        """Loss of the last step, read from the device; NaN before the first."""
        return float("nan") if self._result is None else float(self._result.loss)

    @torch.no_grad()
    def psnr(self) -> float:
        """Render the last step's view and return its PSNR against the photo inside the mask, dB."""
        view = self._training_views()[self._view_index]
        with self.graphs.on_capture_stream():
            photo = self.field.render_train_view(view.camera, view.exposure_time, degree=self.degree).encoded
        assert photo is not None
        return view.target.psnr(photo)

    def timed(self, function: Callable[[], T]) -> T:
        """Call a function whose time, with what the device had left to do, counts as time of the training."""
        started = time.perf_counter()
        try:
            return function()
        finally:
            self.seconds += time.perf_counter() - started

    def synchronize(self) -> None:
        """Wait for the device, as part of the training's time."""
        if self.device.type == "cuda":
            self.timed(lambda: torch.cuda.synchronize(self.device))

    @property
    def skipped_steps(self) -> int:
        """Number of steps that were skipped because the loss or a gradient was not finite."""
        return int(self.capacity.step_counters[0])

    @property
    def overflowed_steps(self) -> int:
        """Number of captured steps that were skipped because a photo had more intersections than their capacity."""
        return self.capacity.overflows

    def came_to(self, every: int) -> bool:
        """Return whether the last step came to a multiple of a number of iterations, or past it."""
        return self.iteration % every < self.step_batch

    def gather(self) -> None:
        """Gather statistics on rank 0 for a checkpoint; raise SehdrError if the ranks' Gaussians differ."""
        if self.ranks is not None:
            self.ranks.reduce_to_leader(list(self.strategy.state(self.field.gaussians.count).values()))
            self.ranks.check_equal(self.field.gaussians.tensors(), self.iteration)

    def check(self, *, wait: bool = True) -> None:
        """Raise SehdrError if more than MAX_SKIPPED steps were skipped; raise the capacity if it was too small.

        Args:
            wait: If False, the latest steps are not considered.
        """
        skipped, overflowed = self.capacity.poll(wait=wait)
        if skipped > MAX_SKIPPED:
            raise SehdrError(
                f"iteration {self.iteration}: {skipped} steps had a loss or gradient that is not finite, "
                f"more than {MAX_SKIPPED}; lower the learning rates or check photos and cameras"
            )
        if overflowed:  # Those steps changed nothing; the next capture has the capacity that they needed.
            self.graphs.invalidate()

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return named tensors and plain values that are the whole state."""
        response = self.field.response
        parts = {
            "gaussians": self.field.gaussians.tensors(),
            "fusion": {} if self.field.fusion is None else self.field.fusion.state_dict(),
            "response": response.state_dict() if isinstance(response, torch.nn.Module) else {},
            "optimizer": optimizer_tensors(self.optimizer, self.batch),
            "densification": self.strategy.state(self.field.gaussians.count),
            "average": self.average.state(),
        }
        order, remaining = self.order.state()
        parts["generators"] = {"order": order, "device": self.generator.get_state()}
        tensors = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        return tensors, {"iteration": self.iteration, "order": remaining, "skipped_steps": self.skipped_steps}

    def load_state(self, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
        """Continue from state(); the field's Gaussians must already be those of the state."""
        load_optimizer_tensors(self.optimizer, under(tensors, "optimizer."), self.batch)
        statistics = {name: value.to(self.device) for name, value in under(tensors, "densification.").items()}
        self.strategy.load_state(statistics)
        self.average.load_state({name: value.to(self.device) for name, value in under(tensors, "average.").items()})
        if self.ranks is not None and not self.ranks.leads:  # The sum over the ranks counts them once.
            for total in statistics.values():
                total.zero_()
        generators = under(tensors, "generators.")
        self.order.load_state(generators["order"], values["order"])
        if self.generator.get_state().numel() == generators["device"].numel():
            self.generator.set_state(generators["device"].cpu())
        self.iteration = self.first_iteration = values["iteration"]
        self.capacity.step_counters[0] = values["skipped_steps"]

    def _reserve_rows(self) -> None:
        """Reserve rows for the Gaussians that refinements will add; the same number on all ranks."""
        gaussians, count = self.field.gaussians, self.field.gaussians.count
        rows = self.strategy.reserved_rows(self.iteration, count)
        if rows == count or not count <= self._rows <= MAX_RESERVE * count:
            self._rows = rows
        if gaussians.reserved != self._rows:
            gaussians.reserve(self._rows, self.optimizer)

    def _flat_gradients(self) -> FlatGradients:
        """Return the buffer of all gradients, which ranks exchange; allocated anew when parameters change."""
        if self._flat is None or not self._flat.fits(self.optimizer):
            self._flat = None  # Freed first, because it is large.
            self._flat = FlatGradients(self.optimizer, self.rank, self.batch, factored=self.factored)
        return self._flat

    def _training_views(self) -> ViewStack | PhotoStream | Sequence[TrainingView]:
        """Return the training views, uploaded at the first call; late in the training, codes become intervals."""
        if self._source is None:
            loss = self.config.loss
            light = self.field.response if compares_exposures(loss, self.field) else None
            estimates = light_estimates(self._views, light, loss, self.device, holding=True)
            options = {"clipping": loss.clipping, "light": light, "estimates": estimates, "truth": loss.uses_hdr}
            source = photo_source(self._views, self.field.base_time, self.device, **options)
            self._source = make_view_source(source, self.config.schedule.photo_cache, self.graphs.enabled)
            self._scale = source.scale
        if not self._widened and self.iteration > INTERVALS_FROM * self.total:
            self._widened = True
            self._scale.widen()
        return self._source
