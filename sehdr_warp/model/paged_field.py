"""A radiance field whose Gaussians do not fit into the memory of a GPU: those that a camera may see are copied to it.

The rows are cut into cells. Rows of a merged run are in an order in which neighbors in space are neighbors in memory,
so cells are compact; in another order the result is the same, but fewer cells can be left out. Cells outside of the
field of view are left out. If the others do not fit into the budget, the farthest are taken at a lower level of detail:
LEVEL_STEP neighboring Gaussians become one, with their mean and covariance.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..errors import SehdrError
from ..scene import Camera
from ..scene.camera import require_camera
from .gaussians import PARAMETER_NAMES, Gaussians
from .pixel_filter import PhotoFilters
from .radiance_field import NO_DATA, RadianceField
from .renders import DirectionalRender, RenderedView

CELL = 1 << 16  # Gaussians of a cell
DEVIATIONS = 3.0  # Size of a Gaussian in the bounds of its cell, standard deviations
LEVEL_STEP = 8
MOST_OPACITY = 0.99  # Of a Gaussian that stands for several
RENDER_BYTES = 240  # Of a Gaussian during a render, beside its parameters: features, projections, intersections


class PagedField(RadianceField):
    """A RadianceField that renders on a device with a limited memory; its Gaussians stay on the CPU.

    Attributes:
        budget: Bytes that the Gaussians of one picture may take there.
    """

    def __init__(self, field: RadianceField, device: torch.device, budget: int):
        """Wrap a field on the CPU, to be rendered on a device; `budget` as in the attributes."""
        super().__init__(
            field.gaussians,
            field.response.to(device) if isinstance(field.response, torch.nn.Module) else field.response,
            fusion=None if field.fusion is None else field.fusion.to(device),
            **_options(field),
        )
        self.confidence, self.clipped_stops = field.confidence, field.clipped_stops
        self.photo_filters = field.photo_filters
        if field.along_rays:  # As a file states; that of a run follows from its cameras.
            self.along_rays = True
        self._device, self.budget = device, budget
        tensors = field.gaussians.tensors()
        self._low, self._high = boxes_around(tensors["means"], tensors["log_scales"], CELL)
        self._pages: OrderedDict[tuple[int, int], dict[str, Tensor]] = OrderedDict()
        self._versions: tuple[int, ...] = ()

    @property
    def render_device(self) -> torch.device:
        """Device that pictures are rendered on."""
        return self._device

    @property
    def row_bytes(self) -> int:
        """Bytes of a Gaussian on the device: twice its parameters, as they are joined for a picture, and its render."""
        return 8 * (14 + 3 * self.gaussians.harmonics_rest.shape[1]) + RENDER_BYTES

    def levels(self, camera: Camera | None, position: np.ndarray) -> list[tuple[int, int]]:
        """Return the cells to render, and whether at full detail (0) or at a lower level (1).

        Args:
            camera: The camera, in scene coordinates; None for one that looks everywhere.
            position: [3] scene coordinates, from which distances are measured.
        """
        inside = np.ones(len(self._low), bool)
        if camera is not None and camera.is_pinhole:
            inside = boxes_in_view(self.normalization.camera(camera), self._low, self._high)
        cells = np.flatnonzero(inside)
        place = self.normalization.points(position)
        nearest = np.clip(place, self._low[cells], self._high[cells])
        cells = cells[np.argsort(np.linalg.norm(nearest - place, axis=1), kind="stable")]
        counts = np.minimum(CELL, self.gaussians.count - CELL * cells)
        rows = self.budget // self.row_bytes
        # Detail from the nearest cell on, as far as all others still fit at the lower level.
        coarse = -(-counts // LEVEL_STEP)
        remaining = coarse.sum() - np.cumsum(coarse)
        full = np.cumsum(counts) + remaining <= rows
        number = int(full.sum())
        if not number and len(cells):
            needed = int(coarse.sum()) * self.row_bytes
            raise SehdrError(
                f"out of memory: {coarse.sum()} Gaussians at the lower level of detail need {needed / 1e9:.1f} GB on "
                f"{self.render_device}, and {self.budget / 1e9:.1f} GB may be used; use a larger GPU or --device cpu"
            )
        return [(int(cell), int(place >= number)) for place, cell in enumerate(cells)]

    def render(
        self, camera: Camera, *, degree: int | None = None, data: Mapping[str, Tensor] = NO_DATA
    ) -> RenderedView:
        """Render the HDR view of a camera, as RadianceField.render."""
        levels = self._levels_of(camera)
        parts = {name: self._of_rows(values, levels) for name, values in data.items()}
        return self._part(levels).render(camera, degree=degree, data=parts)

    def render_ldr(self, camera: Camera, exposure_time: float | None = None, *, degree: int | None = None) -> Tensor:
        """Render a simulated photo, as RadianceField.render_ldr."""
        return self._part(self._levels_of(camera)).render_ldr(camera, exposure_time, degree=degree)

    def render_mean(self, camera: Camera, values: Tensor) -> Tensor:
        """Render the mean of values [N], as RadianceField.render_mean."""
        levels = self._levels_of(camera)
        return self._part(levels).render_mean(camera, self._of_rows(values, levels))

    def render_directions(
        self, position: np.ndarray, directions: Tensor, *, without: Sequence[Tensor] = (), **options: Any
    ) -> DirectionalRender:
        """Render along directions, as RadianceField.render_directions."""
        if any(len(index) for index in without):
            raise SehdrError("lights of a scene that does not fit into the GPU cannot be left out; use --device cpu")
        levels = self.levels(None, position)
        if options.get("shares") is not None:
            options["shares"] = self._of_rows(options["shares"], levels)
        part = self._part(levels)
        if self.confidence is not None:  # Gathered here alone: other pictures of millions of Gaussians do not need it.
            part.confidence = self._of_rows(self.confidence, levels)
        return part.render_directions(position, directions, **options)

    def radiance_towards(self, position: np.ndarray, *, degree: int | None = None) -> Tensor:
        """Return radiance on the CPU, as RadianceField.radiance_towards; cells are computed one after the other."""
        cells = range(len(self._low))
        parts = [self._part([(cell, 0)]).radiance_towards(position, degree=degree) for cell in cells]
        return torch.cat([part.to(self.gaussians.means.device) for part in parts])

    def _levels_of(self, camera: Camera) -> list[tuple[int, int]]:
        """Return the cells to render for a picture of a camera, as levels() does."""
        require_camera(camera)
        return self.levels(camera, camera.position)

    def _part(self, levels: list[tuple[int, int]]) -> RadianceField:
        """Return the field of some cells, on the device."""
        # An edit of the Gaussians, such as a gain of a light, makes the copies out of date.
        versions = tuple(getattr(self.gaussians, name)._version for name in PARAMETER_NAMES)
        if versions != self._versions:
            self._pages.clear()
            self._versions = versions
        pages = [self._page(key) for key in levels]
        # Pages beyond the budget that this picture does not need are dropped, the longest unused first.
        rows = sum(len(page["means"]) for page in self._pages.values())
        for key in list(self._pages):
            if rows * self.row_bytes <= self.budget or key in set(levels):
                break
            rows -= len(self._pages.pop(key)["means"])
        if not pages:
            pages = [self._empty()]
        joined = {name: torch.cat([page[name] for page in pages]) for name in pages[0]}
        part = RadianceField(Gaussians(**joined), self.response, fusion=self.fusion, **_options(self))
        part.requires_grad_(False)
        part.photo_cameras, part.along_rays = self.photo_cameras, self.along_rays
        if self.filters is not None:
            mean, least = self.filters
            least = None if least is None else self._of_rows(least, levels)
            part.filters = PhotoFilters(self._of_rows(mean, levels), least)
        return part

    def _page(self, key: tuple[int, int]) -> dict[str, Tensor]:
        """Return a cell at a level of detail on the device, copied there if it is not there yet."""
        if key not in self._pages:
            cell, level = key
            rows = slice(cell * CELL, (cell + 1) * CELL)
            page = {name: tensor[rows] for name, tensor in self.gaussians.tensors().items()}
            page = coarser(page) if level else page
            self._pages[key] = {name: tensor.to(self.render_device) for name, tensor in page.items()}
        self._pages.move_to_end(key)
        return self._pages[key]

    def _of_rows(self, values: Tensor, levels: list[tuple[int, int]]) -> Tensor:
        """Return values [N] of the Gaussians of some cells, on the device."""
        return values.cpu()[self._rows(levels)].to(self.render_device)

    def _rows(self, levels: list[tuple[int, int]]) -> Tensor:
        """Return the indices of the rows of some cells, of the first of each group at a lower level."""
        steps = {cell: LEVEL_STEP if level else 1 for cell, level in levels}
        parts = [torch.arange(k * CELL, min((k + 1) * CELL, self.gaussians.count), step) for k, step in steps.items()]
        return torch.cat(parts) if parts else torch.zeros(1, dtype=torch.int64)

    def _empty(self) -> dict[str, Tensor]:
        """Return one transparent Gaussian, for a camera that sees nothing."""
        page = {name: tensor[:1].to(self.render_device) for name, tensor in self.gaussians.tensors().items()}
        page["opacity_logits"] = torch.full_like(page["opacity_logits"], -20.0)
        return page


def coarser(page: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return Gaussians that each stand for LEVEL_STEP consecutive ones: their mean, covariance, color and coverage.

    Args:
        page: Parameters of N Gaussians on the CPU, neighbors in space one after the other.

    Returns:
        Parameters of N / LEVEL_STEP Gaussians, rounded up.
    """
    count = len(page["means"])
    groups = torch.arange(count) // LEVEL_STEP
    number = int(groups[-1]) + 1
    scales = page["log_scales"].double().exp()
    areas = scales.sort(dim=1).values[:, 1:].prod(1)
    weights = torch.sigmoid(page["opacity_logits"].double()) * areas
    totals = torch.zeros(number, dtype=torch.float64).index_add_(0, groups, weights)
    shares = weights / totals[groups].clamp_min(1e-300)

    def mean(values: Tensor) -> Tensor:
        flat = values.double().reshape(count, -1) * shares[:, None]
        summed = torch.zeros(number, flat.shape[1], dtype=torch.float64).index_add_(0, groups, flat)
        return summed.reshape(number, *values.shape[1:])

    means = mean(page["means"])
    turns = Rotation.from_quat(np.roll(page["quaternions"].double().numpy(), -1, axis=1)).as_matrix()
    axes = torch.from_numpy(turns) * scales[:, None, :]
    offsets = page["means"].double() - means[groups]
    squares, vectors = torch.linalg.eigh(mean(axes @ axes.mT + offsets[:, :, None] * offsets[:, None, :]))
    vectors[:, :, 2] *= torch.linalg.det(vectors).sign()[:, None]
    log_scales = 0.5 * squares.clamp_min(1e-20).log()
    coverage = totals / log_scales[:, 1:].sum(1).exp()  # Eigenvalues ascend.
    quaternions = np.roll(Rotation.from_matrix(vectors.numpy()).as_quat(), 1, axis=1)
    values = {
        "means": means,
        "log_scales": log_scales,
        "quaternions": torch.from_numpy(quaternions),
        "opacity_logits": torch.logit(coverage.clamp(1e-6, MOST_OPACITY)),
        "harmonics_dc": mean(page["harmonics_dc"]),
        "harmonics_rest": mean(page["harmonics_rest"]),
    }
    return {name: tensor.to(torch.float32) for name, tensor in values.items()}


def boxes_around(means: Tensor, log_scales: Tensor, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [B, 3] float64, low and high, of boxes that each hold `size` consecutive Gaussians."""
    reach = DEVIATIONS * log_scales.amax(1, keepdim=True).exp()
    low = torch.stack([part.amin(0) for part in (means - reach).split(size)]).double().numpy()
    high = torch.stack([part.amax(0) for part in (means + reach).split(size)]).double().numpy()
    return low, high


def boxes_in_view(camera: Camera, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return which boxes [B, 3] a pinhole camera may see: a bool [B]; some that it does not see may be included."""
    middle, half = (low + high) / 2, (high - low) / 2
    edges = np.array(
        [
            [camera.fx, 0, camera.cx],  # Left: fx x + cx z >= 0
            [-camera.fx, 0, camera.width - camera.cx],
            [0, camera.fy, camera.cy],
            [0, -camera.fy, camera.height - camera.cy],
            [0, 0, 1],
        ]
    )
    normals = edges @ camera.world_to_camera[:3, :3]
    inside = (middle - camera.position) @ normals.T + half @ np.abs(normals).T >= 0
    return np.all(inside, axis=1)


def _options(field: RadianceField) -> dict[str, Any]:
    """Return the keyword arguments of a field that differs in Gaussians, response and fusion alone."""
    return {
        "base_time": field.base_time,
        "color_model": field.color_model.name,
        "tone_map": field.tone_map,
        "antialiased": field.antialiased,
        "deterministic": field.deterministic,
        "normalization": field.normalization,
        "photo_focals": field.photo_focals,
    }
