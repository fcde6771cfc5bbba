"""The training views: the order in which steps take them, and the form in which they lie on the device."""

import operator
from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor

from ..errors import InputError
from ..model.radiance_field import RadianceField
from ..rasterizer.code_residual import CodeScale
from ..runs.config import Config
from ..runs.light_estimates import ClippedLight, light_estimates
from ..scene import Scene, View
from .losses import INTERVALS_FROM, compares_exposures
from .photo_stream import PhotoStream, make_view_source
from .targets import PhotoSource, TrainingView, ViewStack


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


class TrainingViews:
    """The training views in the form that steps take.

    They are uploaded at the first access. In the last part of a training, bright codes become intervals.

    Attributes:
        scale: Values and intervals that the codes stand for.
    """

    def __init__(self, views: Sequence[View], field: RadianceField, config: Config, *, use_cuda_graph: bool):
        """Prepare the views of a field's normalized scene; steps are captured if use_cuda_graph."""
        self._views, self._field, self._config, self._use_cuda_graph = views, field, config, use_cuda_graph
        self._source: ViewStack | PhotoStream | Sequence[TrainingView] | None = None
        self._widened = False
        self.scale = CodeScale(torch.empty(0))

    @cached_property
    def estimates(self) -> list[ClippedLight] | None:
        """Estimates of each view's clipped light; None as by light_estimates(), or if colors are encoded values."""
        field = self._field
        if field.color_model.encoded:
            return None
        return light_estimates(self._views, field.response, self._config.loss, field.gaussians.means.device)

    @property
    def loss_estimates(self) -> list[Tensor] | None:
        """The estimates [h, w, 6] that the loss pulls clipped light towards; None if it compares no exposures."""
        estimates = self.estimates if compares_exposures(self._config.loss, self._field) else None
        return None if estimates is None else [estimate.log_light for estimate in estimates]

    def source(self, iteration: int) -> ViewStack | PhotoStream | Sequence[TrainingView]:
        """Return the views that the step of an iteration selects from; uploads them at the first call."""
        if self._source is None:
            self._source = self._upload()
        if not self._widened and iteration > INTERVALS_FROM * self._config.schedule.iterations:
            self._widened = True
            self.scale.widen()
        return self._source

    def _upload(self) -> ViewStack | PhotoStream | Sequence[TrainingView]:
        """Return the views on the device, or as a source that uploads them one by one."""
        loss, field = self._config.loss, self._field
        device = field.gaussians.means.device
        response = field.response if compares_exposures(loss, field) else None
        source = PhotoSource(
            self._views,
            field.base_time,
            device,
            clipping=loss.clipping,
            compare_by=response,
            estimates=self.loss_estimates,
            truth=loss.uses_hdr,
        )
        self.scale = source.scale
        return make_view_source(source, self._config.schedule.photo_cache, self._use_cuda_graph)
