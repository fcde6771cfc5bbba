"""The 3D Gaussians of a scene: parameters, start values, and changes of their number during training."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from ..errors import SehdrError
from ..parallel import thread_count
from ..splats.arrays import HARMONIC_0

PARAMETER_NAMES = ("means", "log_scales", "quaternions", "opacity_logits", "harmonics_dc", "harmonics_rest")
INVISIBLE_LOGIT = -1e4  # Opacity logit whose sigmoid is exactly 0 in float32


class Optimizer(Protocol):
    """An optimizer with tensors for each parameter, laid out as in torch.optim."""

    param_groups: list[dict[str, Any]]
    state: Any


class Gaussians(nn.Module):
    """N anisotropic 3D Gaussians with a view-dependent color.

    Attributes:
        means: [N, 3] centers, in the normalized coordinates of the field (scene/normalization.py).
        log_scales: [N, 3] natural logarithms of the standard deviations, in the same units.
        quaternions: [N, 4] rotations (w, x, y, z) of any length but zero.
        opacity_logits: [N]; the opacity is their sigmoid.
        harmonics_dc: [N, 1, 3] real spherical harmonics of degree 0; the color model says what their sum means.
        harmonics_rest: [N, K - 1, 3] harmonics of higher degrees, K = (degree + 1)^2.
        active_count: [1] int32, number of rows that are Gaussians while a step runs on reserved rows; else None.
        reallocations: How often the parameters moved to other memory; CUDA graphs captured before are then invalid.
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity_logits: Tensor
    harmonics_dc: Tensor
    harmonics_rest: Tensor

    def __init__(self, means, log_scales, quaternions, opacity_logits, harmonics_dc, harmonics_rest):
        """Wrap the tensors as parameters; contiguous ones are not copied.

        Raises ValueError for shapes that do not fit each other.
        """
        super().__init__()
        tensors = (means, log_scales, quaternions, opacity_logits, harmonics_dc, harmonics_rest)
        count, harmonics = means.shape[0], 1 + harmonics_rest.shape[1]
        expected = ((count, 3), (count, 3), (count, 4), (count,), (count, 1, 3), (count, harmonics - 1, 3))
        for name, value, shape in zip(PARAMETER_NAMES, tensors, expected, strict=True):
            if tuple(value.shape) != shape:
                raise ValueError(f"{name} has shape {tuple(value.shape)}, not {shape}")
            setattr(self, name, nn.Parameter(value.detach().contiguous()))
        if math.isqrt(harmonics) ** 2 != harmonics:
            raise ValueError(f"{harmonics} harmonics are not a whole number of degrees")
        self._reserved: ReservedRows | None = None
        self.active_count: Tensor | None = None
        self.reallocations = 0

    @classmethod
    def from_points(
        cls, points: Tensor, dc: Tensor, degree: int, *, opacity: float = 0.1, scale: float = 1.0
    ) -> "Gaussians":
        """Create isotropic Gaussians at points, sized by the distance to their neighbors (3DGS, section 5.1).

        Args:
            points: [N, 3] float32, N >= 1.
            dc: [N, 3] constant part of the color (harmonic times coefficient).
            degree: Highest SH degree; harmonics above 0 start at 0.
            opacity: Start value in (0, 1).
            scale: Factor on the root mean square distance to three neighbors.
        """
        count = points.shape[0]
        extent = max(float((points - points.mean(0)).norm(dim=1).max()), 1e-6)
        if count > 3:
            distance = neighbor_distances(points).square().mean(1).sqrt().to(points)
        else:
            distance = points.new_full((count,), 0.1 * extent)
        # Bounds for coinciding points and for outliers.
        log_scales = (scale * distance.clamp(1e-5 * extent, extent)).log()[:, None].expand(-1, 3)
        quaternions = points.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
        logits = points.new_full((count,), math.log(opacity / (1 - opacity)))
        rest = points.new_zeros(count, (degree + 1) ** 2 - 1, 3)
        return cls(points.clone(), log_scales, quaternions, logits, (dc / HARMONIC_0)[:, None, :], rest)

    @property
    def count(self) -> int:
        """Number of Gaussians; within all_rows(), of reserved rows."""
        return self.means.shape[0]

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics."""
        return math.isqrt(1 + self.harmonics_rest.shape[1]) - 1

    def opacities(self) -> Tensor:
        """Return the opacities [N] in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    def tensors(self) -> dict[str, Tensor]:
        """Return the detached parameters by name, in the order of PARAMETER_NAMES."""
        return {name: getattr(self, name).detach() for name in PARAMETER_NAMES}

    def rows(self, index: Tensor) -> dict[str, Tensor]:
        """Return copies of the parameters at an index or mask [N]."""
        return {name: value[index].clone() for name, value in self.tensors().items()}

    def keep_only(self, index: Tensor, optimizer: Optimizer | None = None) -> None:
        """Remove all Gaussians but those at an index or mask [N]; the others keep their optimizer state."""
        if index.dtype == torch.bool:
            index = index.nonzero()[:, 0]  # Once, because indexing by a mask waits for the device.
        reserved, count = self._reserved, self.count
        self.reallocations += reserved is None
        for name in PARAMETER_NAMES:
            if reserved is None:
                self._replace(name, lambda tensor, _: tensor[index], optimizer)
                continue
            old = getattr(self, name)
            for tensor in (old.detach(), *moments_of(optimizer, old).values()):
                tensor[: len(index)] = tensor[index]
            reserved.clear(name, len(index), count)
            self._put(name, *reserved.first(name, len(index)), optimizer)
        self._update_active_count()

    def append(self, rows: dict[str, Tensor], optimizer: Optimizer | None = None) -> None:
        """Append M Gaussians with tensors as returned by rows(); their optimizer state starts at zero."""
        count, total = self.count, self.count + len(rows["means"])
        if self._reserved is not None and total > self._reserved.rows:
            self._reserved = None
        self.reallocations += self._reserved is None
        for name in PARAMETER_NAMES:
            if self._reserved is None:
                self._replace(name, partial(_append_rows, rows[name]), optimizer)
            else:
                self._reserved.all_rows[name].detach()[count:total] = rows[name]
                self._put(name, *self._reserved.first(name, total), optimizer)
        self._update_active_count()

    def reserve(self, rows: int, optimizer: Optimizer | None = None) -> None:
        """Move the parameters to memory with `rows` rows, at least the count.

        Up to that number, changes of the count leave the parameters and their optimizer state in the same memory.
        """
        reserved, count = ReservedRows(rows, self.means.device), self.count
        self._reserved = None  # Its memory is freed while the parameters move.
        for name in PARAMETER_NAMES:
            self._replace(name, reserved.with_all_rows, optimizer)
            parameter = getattr(self, name)
            reserved.all_rows[name], reserved.moments[name] = parameter, moments_of(optimizer, parameter)
            reserved.clear(name, count, rows)
            self._put(name, *reserved.first(name, count), optimizer)
        self._reserved = reserved
        self.reallocations += 1
        self._update_active_count()

    def release(self) -> None:
        """Return to parameters without reserved rows, from the next change of the count on."""
        self._reserved = None

    def surround(self, rows: dict[str, Tensor], optimizer: Optimizer | None = None) -> None:
        """Reserve rows for Gaussians that steps render, but that are no part of count and tensors().

        A block is refined so beside the rest of the scene (blocks/refine.py). Call this before the first step, and not
        if the number of Gaussians will change: that takes the rows. They stay as they are if the optimizer trains the
        others alone (Adam.trained_rows). `rows` are tensors as returned by rows().
        """
        count = self.count
        self.reserve(count + len(rows["means"]), optimizer)
        assert self._reserved is not None
        for name, values in rows.items():
            self._reserved.all_rows[name].detach()[count:] = values

    @property
    def row_count(self) -> int:
        """Number of rows of the parameters in memory: the count, or more if rows are reserved."""
        return self.count if self._reserved is None else self._reserved.rows

    @contextmanager
    def all_rows(self, optimizer: Optimizer) -> Iterator[None]:
        """Give the parameters, also those in the optimizer, all reserved rows within this block.

        Rows beyond the count are invisible and have gradients of 0.
        """
        reserved = self._reserved
        if reserved is None:
            yield
            return
        parameters = {name: getattr(self, name) for name in PARAMETER_NAMES}
        for name in PARAMETER_NAMES:
            self._put(name, reserved.all_rows[name], reserved.moments[name], optimizer)
        self.active_count = reserved.active_count
        try:
            yield
        finally:
            self.active_count = None
            for name, parameter in parameters.items():
                reserved.moments[name] = moments_of(optimizer, reserved.all_rows[name])
                self._put(name, parameter, first_rows(reserved.moments[name], len(parameter)), optimizer)

    def resize(self, count: int, optimizer: Optimizer | None = None) -> None:
        """Change the number of rows to `count`; new rows are zero, and the caller writes their values."""
        if count < self.count:
            self.keep_only(torch.arange(count, device=self.means.device), optimizer)
        elif count > self.count:
            more = count - self.count
            self.append({name: old.new_zeros(more, *old.shape[1:]) for name, old in self.tensors().items()}, optimizer)

    def overwrite(self, values: dict[str, Tensor], optimizer: Optimizer | None = None) -> None:
        """Write values of some parameters in place, and zero their optimizer state."""
        for name, new in values.items():
            parameter = getattr(self, name)
            parameter.detach().copy_(new)
            for moment in moments_of(optimizer, parameter).values():
                moment.zero_()

    def _replace(self, name: str, change: Callable[[Tensor, bool], Tensor], optimizer: Optimizer | None) -> None:
        """Replace a parameter and its moments by change(tensor, whether it is a moment).

        One after another, so that no more than one of them is in memory twice.
        """
        old = getattr(self, name)
        moments, state = moments_of(optimizer, old), {} if optimizer is None else optimizer.state.get(old, {})
        for key in tuple(moments):
            moments[key] = state[key] = change(moments[key], True)
        self._put(name, nn.Parameter(change(old.detach(), False)), moments, optimizer)

    def _put(self, name: str, new: nn.Parameter, moments: dict[str, Tensor], optimizer: Optimizer | None) -> None:
        """Replace the parameter of this name, in the optimizer too, with its moments."""
        old = getattr(self, name)
        setattr(self, name, new)
        if optimizer is None:
            return
        for group in optimizer.param_groups:
            group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
        if old in optimizer.state:
            optimizer.state[new] = optimizer.state.pop(old) | moments

    def _update_active_count(self) -> None:
        """Copy the count to the device, where captured CUDA graphs read it."""
        if self._reserved is not None:
            self._reserved.active_count.fill_(self.count)


def neighbor_distances(points: Tensor) -> Tensor:
    """Return exact distances [N, 3] float64 from each point to its three nearest others.

    Raises:
        SehdrError: If a point is not finite.
    """
    positions = points.detach().double().cpu().numpy()
    not_finite = np.flatnonzero(~np.isfinite(positions).all(1))
    if len(not_finite):
        problem = f"point {not_finite[0]} of {len(points)} is {positions[not_finite[0]].tolist()}"
        raise SehdrError(f"{problem}: a point cloud needs finite coordinates; remove such points")
    from scipy.spatial import KDTree

    tree = KDTree(positions, balanced_tree=False, compact_nodes=False)
    distances = np.empty((len(positions), 4))
    # Query in the order of the tree, so that consecutive queries read the same nodes.
    distances[tree.indices], _ = tree.query(positions[tree.indices], k=4, workers=thread_count())
    return torch.from_numpy(distances[:, 1:])


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors [N, 3] by quaternions [N, 4] (w, x, y, z) of any length but zero."""
    unit = nn.functional.normalize(quaternions, dim=1)
    scalar, axis = unit[:, :1], unit[:, 1:]
    cross = 2 * torch.linalg.cross(axis, vectors)
    return vectors + scalar * cross + torch.linalg.cross(axis, cross)


class ReservedRows:
    """Parameters and moments with memory for more Gaussians than there are, so that their number can change in place.

    A CUDA graph fixes the addresses and the row counts of its tensors. It therefore runs on all reserved rows; those
    beyond the count are Gaussians of opacity 0, which no camera sees. Their moments and gradients are 0, so no step
    changes them. StepRunner reserves them, a gradient step sees all_rows(), and everything else the first `count`.

    Attributes:
        rows: Number of rows.
        all_rows: For each parameter name the parameter with all rows, [rows, ...].
        moments: For each parameter name the optimizer's tensors with all rows.
        active_count: [1] int32 on the device, the number of rows that are Gaussians.
    """

    def __init__(self, rows: int, device: torch.device):
        """Reserve `rows` rows on a device, for parameters that follow."""
        self.rows = rows
        self.all_rows: dict[str, nn.Parameter] = {}
        self.moments: dict[str, dict[str, Tensor]] = {}
        self.active_count = torch.zeros(1, dtype=torch.int32, device=device)

    def clear(self, name: str, first: int, last: int) -> None:
        """Set the rows [first, last) of a parameter to those of an invisible Gaussian, and their moments to 0."""
        values = self.all_rows[name].detach()[first:last]
        for each in (values, *(moment[first:last] for moment in self.moments[name].values())):
            each.zero_()
        if name == "opacity_logits":
            values.fill_(INVISIBLE_LOGIT)
        if name == "quaternions":
            values[:, 0] = 1

    def first(self, name: str, count: int) -> tuple[nn.Parameter, dict[str, Tensor]]:
        """Return the first `count` rows of a parameter as a parameter of its own, and of its moments."""
        return nn.Parameter(self.all_rows[name].detach()[:count]), first_rows(self.moments[name], count)

    def with_all_rows(self, values: Tensor, _is_moment: bool = False) -> Tensor:
        """Copy values into new memory with all rows; clear() sets those that are new."""
        all_rows = values.new_empty(self.rows, *values.shape[1:])
        all_rows[: len(values)] = values
        return all_rows


def _append_rows(added: Tensor, tensor: Tensor, is_moment: bool) -> Tensor:
    """Return a tensor [N, ...] followed by added rows, or by zeros if it is a moment."""
    return torch.cat([tensor, torch.zeros_like(added) if is_moment else added])


def first_rows(moments: dict[str, Tensor], count: int) -> dict[str, Tensor]:
    """Return the first `count` rows of each tensor."""
    return {key: moment[:count] for key, moment in moments.items()}


def moments_of(optimizer: Any, parameter: Tensor) -> dict[str, Tensor]:
    """Return the optimizer's tensors with one row per Gaussian: all but Adam's step counter."""
    state = {} if optimizer is None else optimizer.state.get(parameter, {})
    return {key: value for key, value in state.items() if torch.is_tensor(value) and value.shape == parameter.shape}
