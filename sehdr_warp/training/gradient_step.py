"""One gradient step on a photo: forward, loss, backward, average over the ranks, optimizer step.

GradientStep.run() is the whole step. Nothing in it waits for the device if the number of intersections has a fixed
capacity, so that StepRunner can capture it as a CUDA graph; on several GPUs, as one graph before and one after the
average.
"""

import math
import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ..model.adam import Adam
from ..model.gaussians import moments_of
from ..model.radiance_field import RadianceField
from ..rasterizer import HarmonicsGradients, Rendering
from ..rasterizer.ops.step_updates import decide_step, differentiate, finiteness_of
from ..rasterizer.tile_lists import MAX_SINGLE_SORT
from ..response.learned import EXACT_BELOW
from ..runs.config import Config
from ..scene import Scene
from .flat_gradients import FlatGradients
from .hdr_truth import largest_hdr_truth
from .losses import compared_image, data_loss, extra_images, opacity_loss, size_loss, transmittance_loss
from .ranks import Ranks
from .strategies import SEED_STRIDE, Strategy
from .strategies.base import Schedule
from .training_views import TrainingView

SKIPPED, MOST_INTERSECTIONS, OVERFLOWED = range(3)
"""Indices of GradientStep.step_counters: steps that were not finite, the largest number of intersections, and steps
with more intersections than the capacity. Neither kind of step is applied."""

TURNED_STEPS = 0.5
"""Share of the steps that turn the axis of the order: with all of them, short trainings have 0.3 to 0.5 dB less on
photos, and not more on views that are turned."""

OPAQUE_STEPS = 0.05
"""Share of the steps of a training that make surfaces opaque."""

WHOLE_WEIGHT_FROM = 4000
"""Steps of the shortest training that has the whole weight of the transmittance. Shorter ones have less in proportion:
with the whole weight, those of 600 to 1,000 steps lose 0.2 to 0.7 dB, because colors cannot follow the opacities."""


@dataclass(frozen=True)
class StepOptions:
    """Options of a step that change in the course of a training."""

    degree: int  # SH degree
    refines: bool  # Whether the strategy still changes the number of Gaussians
    makes_opaque: bool  # Whether the step makes surfaces opaque; positions, sizes and rotations then get no gradient
    needs_means2d_grad: bool  # Whether the strategy accumulates the gradients of the projected means


class GraphKey(NamedTuple):
    """Everything that a CUDA graph of a step holds fixed, because it changes which kernels the step launches.

    Consecutive steps of one key share a CUDA graph; only one is kept, so another key is captured anew.
    """

    options: StepOptions  # Options of the step
    exact_response: bool  # Whether Gaussians are so few that a learned response encodes them exactly
    single_sort: bool  # Whether Gaussians are so few that they are sorted in a single pass


@dataclass(frozen=True)
class Gradients:
    """Result of GradientStep.compute_gradients, beside the gradients that the parameters hold."""

    loss: Tensor  # Scalar loss of this rank's photo
    image: Tensor  # [H, W, 3] rendered image that was compared with the photo
    rendering: Rendering  # Of the rasterizer, with what apply_gradients() reads; other tensors are None
    harmonics: HarmonicsGradients | None  # In factored form; None if the parameters hold them


class StepResult(NamedTuple):
    """Result of a step."""

    loss: Tensor  # Scalar, mean over the ranks
    image: Tensor  # [H, W, 3] rendered image that was compared with this rank's photo
    intersections: int  # Number of intersections, or the capacity of the step if it had one


class Dropout:
    """Leaves a share of the Gaussians out of each step (Park et al., DropGaussian, CVPR 2025).

    So few photos are not fitted one by one. The share grows from 0 to `share` over the training. The opacities of the
    others are divided by what is left, so that the mean opacity of each Gaussian stays.

    Attributes:
        factors: [N] factors of the next step on the opacities, 0 for Gaussians that are left out; None without dropout.
    """

    def __init__(self, share: float, random_seed: int, total: int, device: torch.device):
        """Prepare for a training of `total` iterations."""
        self.factors: Tensor | None = None
        self._share, self._random_seed, self._total = share, random_seed, total
        self._generator = torch.Generator(device)

    def draw(self, iteration: int, rows: int) -> None:
        """Draw the Gaussians of the step that ends at an iteration; the same in a resumed training.

        `rows` is N, with reserved rows. The factors keep their memory while it stays, because CUDA graphs read it.
        """
        if not self._share:
            return
        if self.factors is None or len(self.factors) != rows:
            self.factors = torch.empty(rows, device=self._generator.device)
        left = 1 - self._share * iteration / self._total
        self._generator.manual_seed((self._random_seed * SEED_STRIDE + iteration) % 2**63)
        self.factors.bernoulli_(left, generator=self._generator).div_(left)


class OrderAxis:
    """Turns the axis along which half of the steps order Gaussians by depth, at random around the camera's.

    Cameras in one place that look in other directions order Gaussians differently, because each does it by depth along
    its own axis. What is behind others in all photos is not constrained, and may be in front if the camera turns. So
    steps show it now and then. The other half keeps the photos as exact as without.

    Attributes:
        axis: [3] of the next step, in the camera's coordinates; None if it is always the camera's own.
    """

    def __init__(self, angle: float, random_seed: int, device: torch.device):
        """Prepare to turn the axis by up to an angle in degrees, to the sides and up and down."""
        self.axis = torch.tensor([0.0, 0.0, 1.0], device=device) if angle else None
        self._slope, self._random_seed = math.tan(math.radians(angle)), random_seed

    def draw(self, iteration: int) -> None:
        """Draw the axis of the step that ends at an iteration; the same in a resumed training, and on every device.

        It keeps its memory, because CUDA graphs read it.
        """
        if self.axis is not None:
            generator = random.Random(self._random_seed * SEED_STRIDE + iteration)
            slope = self._slope if generator.random() < TURNED_STEPS else 0.0
            for component in self.axis[:2]:
                component.fill_(generator.uniform(-slope, slope))  # Unlike a copy, it does not wait for a GPU.


def opaque_steps(config: Config, schedule: Schedule, *, black_background: bool = False) -> range:
    """Return the iterations of the steps that make surfaces opaque.

    They follow the last refinement, and lie in the second half of a training: earlier, surfaces are misplaced. There
    are none if transmittance has no weight, if transparent parts of photos count as black, or if refinement lasts to
    the end.
    """
    total = config.schedule.iterations
    if not config.loss.transmittance_weight or black_background:
        return range(0)
    start = max(schedule.stop, total // 2)
    return range(start, min(start + math.ceil(OPAQUE_STEPS * total), total))


def transmittance_weight(config: Config, batch: int) -> float:
    """Return the weight of the transmittance in these steps, each of `batch` photos; see WHOLE_WEIGHT_FROM."""
    return config.loss.transmittance_weight * min(1.0, config.schedule.iterations / (WHOLE_WEIGHT_FROM * batch))


class GradientStep:
    """Takes gradient steps of a training: prepare(), then run().

    On several GPUs, StepRunner calls the parts of run() one by one.

    Attributes:
        field: The field that is trained.
        optimizer: Adam over its parameters.
        strategy: Densification strategy, which accumulates gradients of projected means.
        ranks: Processes that train together.
        step_counters: [3] int64, which each step adds to: see SKIPPED. GraphCapacity sets the second one to 0.
        defer_sh_gradients: Keep the gradients of the harmonics in factored form until the optimizer step: a gradient by
            one color per Gaussian in place of 48 numbers; see HarmonicsGradients for their way.
    """

    def __init__(
        self,
        scene: Scene,
        config: Config,
        field: RadianceField,
        optimizer: Adam,
        strategy: Strategy,
        ranks: Ranks | None,
        large_scene: bool,
    ):
        """Prepare steps of a training.

        The HDR truth of the scene scales the HDR loss. In a large scene the opacity penalty spares Gaussians that no
        photo has shown yet, and sizes have no penalty; before a black background transmittance has none.
        """
        self.field, self.optimizer, self.strategy, self.ranks = field, optimizer, strategy, ranks
        self._loss, device = config.loss, field.gaussians.means.device
        self.step_counters = torch.zeros(3, dtype=torch.int64, device=device)
        self.defer_sh_gradients = device.type == "cuda"
        self._largest_truth = largest_hdr_truth(scene, config.loss) * field.base_time
        # They would fade or shrink before a photo shows them. Elsewhere the penalties remove what is not needed.
        self._spares_unseen = large_scene
        self._dropout = Dropout(config.model.dropout, config.seed, config.schedule.iterations, device)
        self._order = OrderAxis(config.model.order_angle, config.seed, device)
        self._transmittance_weight = transmittance_weight(config, 1 if ranks is None else ranks.count)
        self._opaque_steps = opaque_steps(config, strategy.schedule, black_background=scene.black_background)
        self._flat_gradients: FlatGradients | None = None  # Buffer that ranks exchange

    def options_at(self, iteration: int, degree: int) -> StepOptions:
        """Return the options of the step that ends at an iteration."""
        return StepOptions(
            degree,
            refines=not self.strategy.schedule.is_over(iteration),
            makes_opaque=iteration in self._opaque_steps,
            needs_means2d_grad=self.strategy.needs_gradients(iteration),
        )

    def graph_key(self, views: object, options: StepOptions) -> GraphKey | None:
        """Return the key of a step on one of the views; None if it cannot be captured as a CUDA graph."""
        # Display colors compare the exposure time with the base time on the host, so it must be a number there.
        if self.field.color_model.display_referred and not isinstance(getattr(views, "times", None), float):
            return None
        rows = self.field.gaussians.row_count
        return GraphKey(options, exact_response=rows < EXACT_BELOW, single_sort=rows <= MAX_SINGLE_SORT)

    def prepare(self, options: StepOptions, iteration: int) -> None:
        """Prepare what the step of an iteration reads or adds to: in a capture, it would lie in the graph's memory."""
        self._dropout.draw(iteration, self.field.gaussians.row_count)
        self._order.draw(iteration)
        if options.needs_means2d_grad:
            self.strategy.allocate(self.field.gaussians.row_count, self.step_counters.device)

    def run(self, view: TrainingView, options: StepOptions, max_intersections: int | None = None) -> StepResult:
        """Take a step on a view; arguments as of compute_gradients()."""
        with self.reserved_memory():
            gradients = self.compute_gradients(view, options, max_intersections)
            self.average_gradients()
            loss = self.apply_gradients(gradients)
        return StepResult(loss, gradients.image, gradients.rendering.intersection_count)

    @contextmanager
    def reserved_memory(self) -> Iterator[None]:
        """Use all reserved rows, whose number is fixed, and on several ranks a buffer of their gradients.

        The buffer is allocated here, because in a capture it would lie in the graph's memory.
        """
        with self.field.gaussians.all_rows(self.optimizer):
            if self.ranks is not None and not (self._flat_gradients and self._flat_gradients.fits(self.optimizer)):
                rank, count = self.ranks.rank, self.ranks.count
                self._flat_gradients = None  # Frees its memory, which is large.
                self._flat_gradients = FlatGradients(self.optimizer, rank, count, defer_sh=self.defer_sh_gradients)
            yield

    def compute_gradients(
        self, view: TrainingView, options: StepOptions, max_intersections: int | None = None
    ) -> Gradients:
        """Render a view, compute the loss and differentiate it.

        Args:
            view: The training view.
            options: Options of the step.
            max_intersections: Fixed capacity, with which nothing waits for the device.
        """
        target, camera, field = view.target, view.camera, self.field
        sh_gradients: list[Tensor] = []
        render = field.render_photo(
            camera,
            view.exposure_time,
            degree=options.degree,
            extra_images=extra_images(self._loss, target.exposure_truth is not None),
            max_intersections=max_intersections,
            encode=not target.scale.compares_exposures,
            opacity_factors=self._dropout.factors,
            order_axis=self._order.axis,
            sh_gradient_hook=sh_gradients.append if self.defer_sh_gradients else None,
        )
        loss = data_loss(field, render, target, self._loss, self._largest_truth)
        if options.refines and self._loss.opacity_weight:
            moments = None
            if self._spares_unseen and camera.directions is None:  # Renders of wide cameras have no extents.
                moments = moments_of(self.optimizer, field.gaussians.opacity_logits).get("exp_avg_sq")
            loss = loss + opacity_loss(field, render, self._loss.opacity_weight, moments)
        if options.refines and self._loss.size_weight and not self._spares_unseen:
            loss = loss + size_loss(field.gaussians, self._loss.size_weight)
        if options.makes_opaque:
            loss = loss + transmittance_loss(render, target, self._transmittance_weight)
        # Drop references to tensors that the backward pass does not need, so that their memory is reused in it.
        names = {"image", "transmittance", "depths"}
        if options.needs_means2d_grad:
            render.rendering.means2d.retain_grad()
        else:
            names |= {"means2d", "extents"}
        rendering = replace(render.rendering, **dict.fromkeys(names))
        image = compared_image(render, target)
        del render, target, view
        differentiate(loss)
        if options.makes_opaque:  # Else Gaussians at the borders of photos would grow into what no photo shows.
            gaussians = field.gaussians
            gaussians.means.grad = gaussians.log_scales.grad = gaussians.quaternions.grad = None
        harmonics = None
        if self.defer_sh_gradients:
            values = sh_gradients[0].contiguous()
            harmonics = HarmonicsGradients(values[None], camera.position[None], field.gaussians.means, options.degree)
        if self._flat_gradients is not None:
            self._flat_gradients.collect(loss, rendering.overflow, harmonics)
        return Gradients(loss.detach(), image.detach(), rendering, harmonics)

    def average_gradients(self) -> None:
        """Average the gradients over the ranks."""
        if self.ranks is not None and self._flat_gradients is not None:
            self.ranks.all_reduce_mean(self._flat_gradients.buffer)

    def apply_gradients(self, gradients: Gradients) -> Tensor:
        """Update the parameters, and return the loss. Does not wait for the device.

        The device leaves out the update if loss or gradients are not finite, or if there were more intersections than
        memory.
        """
        rendering, loss, harmonics = gradients.rendering, gradients.loss, gradients.harmonics
        overflow = rendering.overflow
        if self._flat_gradients is not None:
            loss, overflow, harmonics = self._flat_gradients.distribute()
        groups, color_gradients = self.optimizer.param_groups, [] if harmonics is None else [harmonics.grad_colors]
        grads = [p.grad for group in groups for p in group["params"] if p.grad is not None] + color_gradients
        flags = decide_step(loss, finiteness_of(grads), overflow, self.step_counters, rendering.needed_intersections)
        self.optimizer.step(flags, harmonics, self.field.gaussians.active_count)
        if rendering.means2d is not None:
            height, width, _ = gradients.image.shape
            self.strategy.accumulate(rendering, width, height, flags.applied)
        self.optimizer.zero_grad()
        return loss
