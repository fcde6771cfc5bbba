"""The training loop's state and its single step. What happens around steps is train.py's business."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TypeGuard

import torch
from torch import Tensor

from ..errors import SehdrError
from ..model.radiance_field import RadianceField, RenderedView
from ..rasterizer import CudaGraphRunner, HarmonicsGradients, Rendering
from ..rasterizer.code_residual import CodeScale
from ..rasterizer.memory import failed_allocation
from ..rasterizer.tile_lists import ONE_SORT
from ..rasterizer.training_step import differentiate
from ..response.learned import EXACT_BELOW
from ..runs.checkpoint import under
from ..runs.config import Config
from ..scene import Camera, Scene
from . import optimizer as adam
from .births import born_rows
from .densification import SEED_STEP, make_densification
from .graph_capacity import GraphCapacity
from .initialization import make_matcher, scene_extent
from .light_estimates import light_estimates
from .losses import INTERVALS_FROM, compares_exposures, data_loss, extra_images, with_opacity_penalty
from .matching import Matcher
from .moving_average import MovingAverage
from .photo_order import PhotoOrder
from .photo_stream import PhotoStream, make_view_source
from .ranks import Ranks
from .targets import TrainingView, ViewStack, largest_truth, photo_source
from .wide_views import has_wide_views

CHECK_EVERY = 20  # Iterations between looks at what steps count on the device
COMPARE_EVERY = 500  # Iterations between looks at whether all ranks still have the same Gaussians
MOST_ROOM = 1.5  # In multiples of the Gaussians: rows that do not count cost memory, and a little time
MOST_SKIPPED = 20  # Steps with a loss or gradient that is not finite are skipped; more than so many end the training


class Trainer:
    """Field, optimizer, densification, random generators and view order of a training, and how they advance.

    Everything that decides the next step is in state(): a trainer that load_state()s it continues bit for bit on the
    CPU. No global random state is used.

    ranks: the processes that train together. A step is then one photo on each of them and as many iterations; what is
    to happen at an iteration does at the step that comes to or past it.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        field: RadianceField,
        matcher: Callable[[], Matcher] | None = None,
        ranks: Ranks | None = None,
    ):
        self.ranks = ranks
        self.rank, self.batch = (0, 1) if ranks is None else (ranks.rank, ranks.count)
        self.photos = 1  # Of the last step, which it made iterations
        self.config, self.field = config, field
        self.iteration = 0  # Steps done
        self.device = field.gaussians.means.device
        scene = field.normalization.scene(scene)
        self.extent = scene_extent(scene)
        self.optimizer = adam.make_optimizer(field, config, self.extent, self.batch)
        pixels = sum(view.camera.width * view.camera.height for view in scene.train_views)
        places = torch.tensor([view.camera.position.tolist() for view in scene.train_views], device=self.device)
        self.densification = make_densification(config, self.extent, pixels, places)
        self._averaging = MovingAverage(config, self.densification.stop)
        self._views = scene.train_views
        self._seeding = None if has_wide_views(scene, config) else self._births  # By pixels of pinhole photos
        self._matcher = matcher or cache(partial(make_matcher, scene, field.response, self.device))
        # Where light is compared, nothing needs the photo encoded.
        self._encoded = not compares_exposures(config.loss, field)
        self._largest_truth = largest_truth(scene, config.loss) * field.base_time
        self._stack: ViewStack | PhotoStream | Sequence[TrainingView] | None = None
        self._scale = CodeScale(torch.empty(0))  # What codes are worth
        self._fine = True  # Whether they are values still, however much light they stand for
        self._order = PhotoOrder(len(self._views), config.seed, self.rank, self.batch)
        self._generator = torch.Generator(device=self.device).manual_seed(config.seed)
        self._index = torch.zeros(1, dtype=torch.int64, device=self.device)
        recorded = self.device.type == "cuda" and config.schedule.use_cuda_graph
        self._recorder = CudaGraphRunner(self.device) if recorded else None
        # What follows the exchange of gradients is a recording of its own.
        self._follower = CudaGraphRunner(self.device, self._recorder.stream) if self._recorder and ranks else None
        # Recorded steps work on more rows than there are Gaussians, so that these may become more.
        self._reserves, self._rows = recorded and not config.deterministic, 0
        field.gaussians.release()  # What another training reserved
        # A GPU waits for memory: the 48 numbers of each Gaussian's gradients by its harmonics are never written there.
        self._factored = self.device.type == "cuda"
        self._flat: adam.FlatGradients | None = None
        self._launched: set = set()
        self._capacity = GraphCapacity(self.device)
        self._loss: Tensor | None = None
        self._shown = torch.empty(0)  # What the last step compared with its photo
        self._last_index = 0

    @property
    def degree(self) -> int:
        """The degree of the harmonics at this iteration: one more every sh_degree_interval."""
        return self.config.degree_at(self.iteration)

    @property
    def loss(self) -> float:
        """Of the last step, read from the device."""
        return float("nan") if self._loss is None else float(self._loss)

    @torch.no_grad()
    def psnr(self) -> float:
        """dB, of the last step's view as the scene shows it now, against its photo, where the mask counts."""
        view = self._training_views()[self._last_index]
        with self._launching():
            photo = self.field.render_train_view(view.camera, view.exposure_time, degree=self.degree).encoded
        assert photo is not None
        return view.target.psnr(photo)

    def render(self, camera: Camera) -> RenderedView:
        """The scene as it is now, between steps."""
        with self._launching():
            return self.field.render(camera, degree=self.degree)

    @property
    def skipped_steps(self) -> int:
        """Steps that were left out because the loss or a gradient was not finite."""
        return int(self._capacity.tally[0])

    @property
    def steps_without_room(self) -> int:
        """Recorded steps of this process that were left out because a photo needed more room than they had."""
        return self._capacity.overflows

    def step(self) -> None:
        """One photo on each rank, one step. Raises SehdrError if more than MOST_SKIPPED steps had to be skipped."""
        # The last step may be more photos than iterations are left.
        self.photos = min(self.batch, max(1, self.config.schedule.iterations - self.iteration))
        self.densification.photos = self.photos
        self.iteration += self.photos
        views, gaussians = self._training_views(), self.field.gaussians
        index = self._order.next()
        if self._reserves and not self._rows:
            self._make_room()
        rows, watched = gaussians.reserved, self.densification.needs_gradients(self.iteration)
        if watched:
            self.densification.prepare(rows, self.device)
        rate = adam.means_rate(self.config, self.extent, self.iteration, self.batch)
        adam.set_means_rate(self.optimizer, rate)
        # The last: few are ordered otherwise, and a learned response encodes few otherwise, by kernels of their own.
        kind = (self.degree, watched, rows < EXACT_BELOW, rows <= ONE_SORT)
        self._last_index, count, moves = index, gaussians.count, gaussians.reallocations
        if self._can_record(views, kind):
            self._loss, self._shown = self._replay(views, index, watched, kind)
            if isinstance(views, PhotoStream):
                views.release(self._order.peek())
        else:
            with self._launching():
                self._loss, self._shown = self._step(lambda: self._gradients(views[index], watched), self._apply)
        self.densification.perturb(self.iteration, gaussians, rate)
        if self._change() and self._recorder is not None:
            # Other Gaussians need about so many times the room.
            growth, stayed = gaussians.count / max(1, count), gaussians.reallocations == moves
            if not self._capacity.rescale(growth, keep=stayed):
                self._invalidate()
        self._averaging.update(self.iteration, self.photos, gaussians)
        if self.came_to(CHECK_EVERY):
            self.check(wait=False)
        if self.came_to(COMPARE_EVERY):
            self.settle()

    def came_to(self, every: int) -> bool:
        """Whether the last step came to or past a multiple of a number of iterations."""
        return self.iteration % every < self.photos

    def settle(self) -> None:
        """Gathers on rank 0 what belongs to a checkpoint. Raises SehdrError where the ranks are no longer alike."""
        if self.ranks is not None:
            self.ranks.collect(list(self.densification.state(self.field.gaussians.count).values()))
            self.ranks.compare(self.field.gaussians.tensors(), self.iteration)

    def _change(self) -> bool:
        """Changes the Gaussians where the iteration is one for it: rank 0 does, for all; whether there are others or
        more now."""
        gaussians, strategy, ranks = self.field.gaussians, self.densification, self.ranks
        given = self.iteration, gaussians, self.optimizer, self._generator, self._seeding
        if ranks is None:
            changed = strategy.change(*given)
        elif not strategy.changes_at(self.iteration):
            return False
        else:
            ranks.collect(list(strategy.state(gaussians.count).values()))
            decided = ranks.leads and strategy.change(*given)
            told = [decided, gaussians.count, bool(strategy.state(gaussians.count))]
            told = torch.tensor(told, dtype=torch.int64, device=self.device)
            ranks.spread([told])
            changed, count, watching = told.tolist()
            gaussians.resize(count, self.optimizer)
            if not watching:
                strategy.load_state({})
            ranks.spread([*gaussians.tensors().values(), *self.optimizer.moments(gaussians.parameters())])
        if changed and self._reserves:
            self._make_room()
        return bool(changed)

    def _make_room(self) -> None:
        """Room for the Gaussians that changes will add, alike on all ranks."""
        gaussians, count = self.field.gaussians, self.field.gaussians.count
        wanted = self.densification.room(self.iteration, count)
        if wanted == count or not count <= self._rows <= MOST_ROOM * count:
            self._rows = wanted
        if gaussians.reserved != self._rows:
            gaussians.reserve(self._rows, self.optimizer)

    def _invalidate(self) -> None:
        for recorder in (self._recorder, self._follower):
            if recorder is not None:
                recorder.invalidate()

    def _births(self, wanted: Tensor, room: int) -> tuple[dict[str, Tensor], Tensor]:
        """New Gaussians where the step's photo is explained worst; a resumed training has the same."""
        seed = self.config.seed * SEED_STEP + self.iteration
        view, index = self._training_views()[self._last_index], self._last_index
        with self._launching():
            shown = self._shown if self._encoded else self.field.response.encode_extended(self._shown)
            return born_rows(self.field, self._matcher(), shown, view, index, wanted, room, seed)

    def _step(self, gradients: Callable[[], "_Seen"], apply: Callable[["_Seen"], Tensor]) -> tuple[Tensor, Tensor]:
        """Gradients, of all ranks, and the step that they make; its loss, and the image that it compared."""
        with self.field.gaussians.all_rows(self.optimizer):
            if self.ranks is not None:
                self._flattened()  # Not in a recording's own memory.
            seen = gradients()
            if self.ranks is not None and self._flat is not None:
                self.ranks.mean(self._flat.buffer)
            return apply(seen), seen.image

    def _gradients(self, view: TrainingView, watched: bool, capacity: int | None = None) -> "_Seen":
        """Render, compare, differentiate. With a capacity all of it works on fixed memory and nothing waits for the
        device."""
        target, camera, time, field = view.target, view.camera, view.exposure_time, self.field
        also = extra_images(self.config.loss, target.exposure_truth is not None)
        options = {"degree": self.degree, "also": also, "max_intersections": capacity, "encode": self._encoded}
        options |= {"factored": self._factored, "opacity_weight": self.config.loss.opacity_weight}
        photo = field.render_train_view(camera, time, **options)
        harmonics_gradients = photo.harmonics_gradients
        # What the backward pass does not read, or only its first part does, must not stay until the end of the step.
        kept = {"means2d", "extents"} if watched else set()
        unread = {"image", "transmittance", "depths", "means2d", "extents"} - kept
        rendering = replace(photo.rendering, **dict.fromkeys(unread))
        if watched:
            rendering.means2d.retain_grad()
        loss = with_opacity_penalty(data_loss(field, photo, target, self.config.loss, self._largest_truth), photo)
        image = photo.encoded if self._encoded else photo.light
        assert image is not None
        del photo, target, view
        differentiate(loss)
        harmonics = None
        if self._factored:
            values = harmonics_gradients[0].contiguous()
            harmonics = HarmonicsGradients(values[None], camera.position[None], field.gaussians.means, self.degree)
        if self.ranks is not None:
            self._flattened().take(loss, rendering.overflow, harmonics)
        return _Seen(loss.detach(), image.detach(), rendering, watched, harmonics)

    def _apply(self, seen: "_Seen") -> Tensor:
        """The step that gradients make; its loss. Nothing waits for the device."""
        rendering, loss, harmonics, (height, width, _) = seen.rendering, seen.loss, seen.harmonics, seen.image.shape
        incomplete = rendering.overflow
        if self._flat is not None:
            loss, incomplete, harmonics = self._flat.give()
        tally, needed = self._capacity.tally, rendering.needed_intersections
        counted = {"tally": tally, "pairs": needed, "live": self.field.gaussians.live}
        made = adam.guarded_step(self.optimizer, loss, incomplete, harmonics, **counted)
        if seen.watched:
            self.densification.observe(rendering, width, height, made)
        self.optimizer.zero_grad()
        if rendering.needed_intersections is None:
            self._capacity.observe(rendering.intersection_count)
        return loss

    def _flattened(self) -> adam.FlatGradients:
        """The buffer for the gradients of the parameters as they are."""
        if self._flat is None or not self._flat.fits(self.optimizer):
            self._flat = None  # Before there is another: they are large.
            self._flat = adam.FlatGradients(self.optimizer, self.rank, self.batch, factored=self._factored)
        return self._flat

    def _can_record(self, views, kind) -> TypeGuard[ViewStack | PhotoStream]:
        """Whether this step can be a recorded one: on a GPU, photos of one size, after a step like it was launched."""
        if self._recorder is None or not isinstance(views, ViewStack | PhotoStream):
            return False
        if self.field.color_model.encoded and not isinstance(views.times, float):
            return False
        ready = kind in self._launched and self._capacity.known
        self._launched.add(kind)
        return ready

    def _launching(self):
        """Launched work shares stream and memory with recorded steps."""
        return nullcontext() if self._recorder is None else self._recorder.on_capture_stream()

    def _replay(self, views: ViewStack | PhotoStream, index: int, watched: bool, kind) -> tuple[Tensor, Tensor]:
        capacity, recorder, follower = self._capacity.capacity(), self._recorder, self._follower
        assert recorder is not None
        self._index.fill_(index)
        if isinstance(views, PhotoStream):
            views.bring(index)

        def gradients() -> _Seen:
            return self._gradients(views.at(self._index), watched, capacity)

        try:
            if follower is None:
                return recorder.run(kind, lambda: self._step(gradients, self._apply))
            return self._step(
                lambda: recorder.run(kind, gradients),
                lambda seen: follower.run(kind, lambda: self._apply(seen)),
            )
        except RuntimeError as error:
            if failed_allocation(error):
                raise
            # What a broken recording leaves behind on the device is no ground to go on from.
            raise SehdrError(
                f"iteration {self.iteration}: the step could not be recorded as a CUDA graph "
                f"({str(error).splitlines()[0]}); train with --schedule.use-cuda-graph=false, which is slower"
            ) from error

    def check(self, *, wait: bool = True) -> None:
        """Raises SehdrError if more than MOST_SKIPPED steps were skipped. wait: False leaves out the latest."""
        skipped, lacking = self._capacity.poll(wait=wait)
        if skipped > MOST_SKIPPED:
            raise SehdrError(
                f"iteration {self.iteration}: {skipped} steps had a loss or gradient that is not finite, "
                f"more than {MOST_SKIPPED}; lower the learning rates or check photos and cameras"
            )
        if lacking:
            # Steps without room for all pairs changed nothing; record again with what they needed.
            self._invalidate()

    def state(self) -> tuple[dict[str, Tensor], dict]:
        """Named tensors and plain values that together are the whole state."""
        response = self.field.response
        parts = {
            "gaussians": self.field.gaussians.tensors(),
            "fusion": {} if self.field.fusion is None else self.field.fusion.state_dict(),
            "response": response.state_dict() if isinstance(response, torch.nn.Module) else {},
            "optimizer": adam.optimizer_tensors(self.optimizer, self.batch),
            "densification": self.densification.state(self.field.gaussians.count),
            "average": self._averaging.state(),
        }
        order, left = self._order.state()
        parts["generators"] = {"order": order, "device": self._generator.get_state()}
        tensors = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        return tensors, {"iteration": self.iteration, "order": left, "skipped_steps": self.skipped_steps}

    def load_state(self, tensors: dict[str, Tensor], values: dict) -> None:
        """Takes up what state() gave; the field's Gaussians must already be those of the state."""
        adam.load_optimizer_tensors(self.optimizer, under(tensors, "optimizer."), self.batch)
        statistics = {name: value.to(self.device) for name, value in under(tensors, "densification.").items()}
        self.densification.load_state(statistics)
        means = {name: value.to(self.device) for name, value in under(tensors, "average.").items()}
        self._averaging.load_state(means)
        if self.ranks is not None and not self.ranks.leads:  # The sum over the ranks counts them once.
            for total in statistics.values():
                total.zero_()
        generators = under(tensors, "generators.")
        self._order.load_state(generators["order"], values["order"])
        if self._generator.get_state().numel() == generators["device"].numel():
            self._generator.set_state(generators["device"].cpu())
        self.iteration = values["iteration"]
        self._capacity.tally[0] = values["skipped_steps"]

    def _training_views(self) -> ViewStack | PhotoStream | Sequence[TrainingView]:
        if self._stack is None:
            given, loss = (self._views, self.field.base_time, self.device), self.config.loss
            light = self.field.response if compares_exposures(loss, self.field) else None
            estimates = light_estimates(self._views, light, loss, self.device)
            options = {"clipping": loss.clipping, "light": light, "estimates": estimates}
            source = photo_source(*given, truth=loss.uses_hdr, **options)
            self._stack = make_view_source(source, self.config.schedule.photo_cache, self._recorder is not None)
            self._scale = source.scale
        if self._fine and self.iteration > INTERVALS_FROM * self.config.schedule.iterations:
            self._fine = False
            self._scale.widen()
        return self._stack


@dataclass(frozen=True)
class _Seen:
    """What the second half of a step knows of the first: its own loss, the image [H, W, 3] that it compared, what else
    was rendered, whether the densification watches, gradients by the harmonics where no parameter has them."""

    loss: Tensor
    image: Tensor
    rendering: Rendering
    watched: bool
    harmonics: HarmonicsGradients | None
