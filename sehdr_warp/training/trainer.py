"""The training loop's state and its single step. What happens around steps is train.py's business."""

import torch
from torch import Tensor

from ..errors import SehdrError
from ..model.gaussians import PARAMETER_NAMES
from ..model.radiance_field import RadianceField
from ..scene import Scene
from .config import Config
from .densification import make_densification
from .initialization import scene_extent
from .losses import total_loss
from .optimizer import guarded_step, load_optimizer_tensors, make_optimizer, means_rate, optimizer_tensors
from .targets import TrainingView, training_views

CHECK_EVERY = 20
"""Iterations between looks at the count of skipped steps, each of which waits for the device."""


class Trainer:
    """Field, optimizer, densification, random generators and view order of a training, and how they advance.

    iteration: steps done. loss, psnr: of the last step, read from the device on demand.

    Everything that decides the next step is in state(): a trainer that load_state()s it continues bit for bit on the
    CPU. No global random state is used.
    """

    def __init__(self, scene: Scene, config: Config, field: RadianceField):
        self.config = config
        self.field = field
        self.iteration = 0
        self.device = field.gaussians.means.device
        self.extent = scene_extent(scene)
        self.optimizer = make_optimizer(field, config, self.extent)
        self.densification = make_densification(config, self.extent)
        self._views = scene.train_views
        self._levels: dict[int, list[TrainingView]] = {}
        self._order: list[int] = []
        self._order_generator = torch.Generator().manual_seed(config.seed)
        self._generator = torch.Generator(device=self.device).manual_seed(config.seed)
        self._skipped = torch.zeros((), device=self.device)
        self._last: tuple[Tensor, Tensor, Tensor] | None = None

    @property
    def degree(self) -> int:
        """The degree of the harmonics at this iteration: one more every harmonics_every iterations."""
        every = self.config.scaled(self.config.schedule.harmonics_every)
        return min(self.config.model.harmonics_degree, self.iteration // every)

    @property
    def level(self) -> int:
        """How often the photos are halved at this iteration."""
        every = self.config.scaled(self.config.schedule.coarse_every)
        return max(0, self.config.schedule.coarse_levels - (self.iteration - 1) // every)

    @property
    def loss(self) -> float:
        return float("nan") if self._last is None else float(self._last[0])

    @property
    def psnr(self) -> float:
        """PSNR of the last step's simulated photo against the photo, dB."""
        if self._last is None:
            return float("nan")
        _, prediction, truth = self._last
        return float(-10 * (prediction.clamp(0, 1) - truth).square().mean().clamp_min(1e-10).log10())

    @property
    def skipped_steps(self) -> int:
        """Steps that were left out because the loss or a gradient was not finite."""
        return int(self._skipped)

    def step(self) -> None:
        """One photo, one step. Raises SehdrError if more than schedule.nonfinite_limit steps had to be skipped."""
        self.iteration += 1
        view = self._next_view()
        photo = self.field.photograph(
            view.camera, view.exposure_time, degree=self.degree, linear=self.config.loss.linear_weight > 0
        )
        watched = self.densification.needs_gradients(self.iteration)
        if watched:
            photo.rendering.means2d.retain_grad()
        loss = total_loss(self.field, photo, view.target, self.config.loss)
        loss.backward()
        rate = means_rate(self.config, self.extent, self.iteration)
        self.optimizer.param_groups[PARAMETER_NAMES.index("means")]["lr"] = rate
        bad = guarded_step(self.optimizer, loss)
        if watched:
            self.densification.observe(photo.rendering, view.camera.width, view.camera.height, 1 - bad)
        self.optimizer.zero_grad(set_to_none=True)
        gaussians = self.field.gaussians
        self.densification.perturb(gaussians, rate, self._generator)
        self.densification.change(self.iteration, gaussians, self.optimizer, self._generator)
        self._skipped += bad
        self._last = (loss.detach(), photo.encoded.detach(), view.target.encoded)
        if self.iteration % CHECK_EVERY == 0:
            self.check()

    def check(self) -> None:
        """Raises SehdrError if more than schedule.nonfinite_limit steps were skipped."""
        limit = self.config.schedule.nonfinite_limit
        if self.skipped_steps > limit:
            raise SehdrError(
                f"iteration {self.iteration}: {self.skipped_steps} steps had a loss or gradient that is not finite, "
                f"more than schedule.nonfinite_limit = {limit}; lower the learning rates or check photos and cameras"
            )

    def state(self) -> tuple[dict[str, Tensor], dict]:
        """Named tensors and plain values that together are the whole state."""
        parts = {
            "gaussians": self.field.gaussians.tensors(),
            "fusion": {} if self.field.fusion is None else self.field.fusion.state_dict(),
            "optimizer": optimizer_tensors(self.optimizer),
            "densification": self.densification.state(),
            "generators": {"order": self._order_generator.get_state(), "device": self._generator.get_state()},
        }
        tensors = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        return tensors, {"iteration": self.iteration, "order": list(self._order), "skipped_steps": self.skipped_steps}

    def load_state(self, tensors: dict[str, Tensor], values: dict) -> None:
        """Takes up what state() gave; the field's Gaussians must already be those of the state."""
        load_optimizer_tensors(self.optimizer, _part(tensors, "optimizer"))
        self.densification.load_state(
            {name: value.to(self.device) for name, value in _part(tensors, "densification").items()}
        )
        generators = _part(tensors, "generators")
        self._order_generator.set_state(generators["order"].cpu())
        if self._generator.get_state().numel() == generators["device"].numel():
            self._generator.set_state(generators["device"].cpu())
        self.iteration = values["iteration"]
        self._order = list(values["order"])
        self._skipped.fill_(values["skipped_steps"])

    def _next_view(self) -> TrainingView:
        """Every photo once in random order, then again in another."""
        level = self.level
        if level not in self._levels:
            # One resolution at a time: the coarser ones are not needed again.
            self._levels = {level: self._upload(level)}
        views = self._levels[level]
        if not self._order:
            self._order = torch.randperm(len(views), generator=self._order_generator).tolist()
        return views[self._order.pop()]

    def _upload(self, level: int) -> list[TrainingView]:
        loss, field = self.config.loss, self.field
        truth = loss.hdr_truth and loss.linear_weight > 0
        return training_views(self._views, level, field.response, field.base_time, self.device, truth=truth)


def _part(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    return {key.removeprefix(f"{name}."): value for key, value in tensors.items() if key.startswith(f"{name}.")}
