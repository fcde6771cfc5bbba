"""The 3D Gaussians of a scene: their parameters, their start values, and changes of their number during training."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from ..errors import SehdrError
from ..parallel import thread_count
from ..splats.arrays import HARMONIC_0
from .spare_rows import SpareRows, first_rows, moments_of

PARAMETER_NAMES = ("means", "log_scales", "quaternions", "opacity_logits", "harmonics_dc", "harmonics_rest")


class Optimizer(Protocol):
    """What steps parameters and keeps tensors for each of them, laid out as torch.optim does."""

    param_groups: list[dict[str, Any]]
    state: Any


class Gaussians(nn.Module):
    """N anisotropic 3D Gaussians with a view-dependent color.

    means: [N, 3] world coordinates. log_scales: [N, 3] natural logarithms of the standard deviations, world units.
    quaternions: [N, 4] (w, x, y, z), of any length but zero. opacity_logits: [N]; the opacity is their sigmoid.
    harmonics_dc, harmonics_rest: [N, 1, 3] and [N, K - 1, 3], real spherical harmonics of degree 0 and above,
        K = (degree + 1)^2. What their sum means is the color model's choice.
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity_logits: Tensor
    harmonics_dc: Tensor
    harmonics_rest: Tensor

    def __init__(self, means, log_scales, quaternions, opacity_logits, harmonics_dc, harmonics_rest):
        super().__init__()
        given = (means, log_scales, quaternions, opacity_logits, harmonics_dc, harmonics_rest)
        count, harmonics = means.shape[0], 1 + harmonics_rest.shape[1]
        expected = ((count, 3), (count, 3), (count, 4), (count,), (count, 1, 3), (count, harmonics - 1, 3))
        for name, value, shape in zip(PARAMETER_NAMES, given, expected, strict=True):
            if tuple(value.shape) != shape:
                raise ValueError(f"{name} has shape {tuple(value.shape)}, not {shape}")
            setattr(self, name, nn.Parameter(value.detach().contiguous()))
        if math.isqrt(harmonics) ** 2 != harmonics:
            raise ValueError(f"{harmonics} harmonics are not a whole number of degrees")
        self._spare: SpareRows | None = None
        self.live: Tensor | None = None
        """[1] int32, how many of the rows count, where steps work on more."""
        self.moves = 0
        """How often they came to lie elsewhere in memory."""

    @classmethod
    def from_points(
        cls, points: Tensor, dc: Tensor, degree: int, *, opacity: float = 0.1, scale: float = 1.0
    ) -> "Gaussians":
        """Isotropic Gaussians at points, sized by their neighbours (3DGS, section 5.1).

        points: [N, 3] float32, N >= 1; dc: [N, 3] constant part of the color (harmonic times coefficient); scale
        multiplies the root mean square distance to three neighbours.
        """
        count = points.shape[0]
        extent = max(float((points - points.mean(0)).norm(dim=1).max()), 1e-6)
        if count > 3:
            distance = neighbour_distances(points).square().mean(1).sqrt().to(points)
        else:
            distance = points.new_full((count,), 0.1 * extent)
        # Points that coincide, and lone outliers, would start as specks or as clouds over the whole scene.
        log_scales = (scale * distance.clamp(1e-5 * extent, extent)).log()[:, None].expand(-1, 3)
        quaternions = points.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
        logits = points.new_full((count,), math.log(opacity / (1 - opacity)))
        rest = points.new_zeros(count, (degree + 1) ** 2 - 1, 3)
        return cls(points.clone(), log_scales, quaternions, logits, (dc / HARMONIC_0)[:, None, :], rest)

    @property
    def count(self) -> int:
        return self.means.shape[0]

    @property
    def degree(self) -> int:
        """The highest degree of the harmonics."""
        return math.isqrt(1 + self.harmonics_rest.shape[1]) - 1

    def opacities(self) -> Tensor:
        """[N] in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    def tensors(self) -> dict[str, Tensor]:
        """Name to detached parameter, in the order of PARAMETER_NAMES."""
        return {name: getattr(self, name).detach() for name in PARAMETER_NAMES}

    def rows(self, index: Tensor) -> dict[str, Tensor]:
        """Copies of the parameters at an index or mask [N]."""
        return {name: value[index].clone() for name, value in self.tensors().items()}

    def keep(self, index: Tensor, optimizer: Optimizer | None = None) -> None:
        """Keeps only the Gaussians at an index or mask [N], with their optimizer state."""
        if index.dtype == torch.bool:
            index = index.nonzero()[:, 0]  # once: each tensor indexed by a mask would wait for the device
        spare, count = self._spare, self.count
        self.moves += spare is None
        for name in PARAMETER_NAMES:
            old, moments = getattr(self, name), moments_of(optimizer, getattr(self, name))
            if spare is None:
                new = nn.Parameter(old.detach()[index]), {key: moment[index] for key, moment in moments.items()}
            else:
                for tensor in (old.detach(), *moments.values()):
                    tensor[: len(index)] = tensor[index]
                spare.clear(name, len(index), count)
                new = spare.first(name, len(index))
            self._put(name, *new, optimizer)
        self._tell()

    def append(self, rows: dict[str, Tensor], optimizer: Optimizer | None = None) -> None:
        """Adds M Gaussians, given as by rows(); their optimizer state starts at zero."""
        count, total = self.count, self.count + len(rows["means"])
        if self._spare is not None and total > self._spare.rows:
            self._spare = None
        self.moves += self._spare is None
        for name in PARAMETER_NAMES:
            old, added = getattr(self, name), rows[name]
            if self._spare is None:
                nothing, moments = torch.zeros_like(added), moments_of(optimizer, old)
                joined = {key: torch.cat([moment, nothing]) for key, moment in moments.items()}
                new = nn.Parameter(torch.cat([old.detach(), added])), joined
            else:
                self._spare.whole[name].detach()[count:total] = added
                new = self._spare.first(name, total)
            self._put(name, *new, optimizer)
        self._tell()

    def reserve(self, rows: int, optimizer: Optimizer | None = None) -> None:
        """Makes memory for so many, not fewer than there are. As long as they are not more, changes of their number
        leave them, and their optimizer state, where they are."""
        spare = SpareRows(rows, self.means.device)
        for name in PARAMETER_NAMES:
            old = getattr(self, name)
            spare.take(name, old.detach(), moments_of(optimizer, old))
            self._put(name, *spare.first(name, self.count), optimizer)
        self._spare = spare
        self.moves += 1
        self._tell()

    def release(self) -> None:
        """Forgets what was reserved: each parameter is what it is."""
        self._spare = None

    @property
    def reserved(self) -> int:
        """How many there is memory for."""
        return self.count if self._spare is None else self._spare.rows

    @contextmanager
    def all_rows(self, optimizer: Optimizer) -> Iterator[None]:
        """Within this block the parameters, in the optimizer too, have all the rows that reserve() made, which stay
        where they are; those that do not count are seen by no camera, and their gradients are 0."""
        spare = self._spare
        if spare is None:
            yield
            return
        own = {name: getattr(self, name) for name in PARAMETER_NAMES}
        for name in PARAMETER_NAMES:
            self._put(name, spare.whole[name], spare.moments[name], optimizer)
        self.live = spare.live
        try:
            yield
        finally:
            self.live = None
            for name, parameter in own.items():
                spare.moments[name] = moments_of(optimizer, spare.whole[name])
                self._put(name, parameter, first_rows(spare.moments[name], len(parameter)), optimizer)

    def resize(self, count: int, optimizer: Optimizer | None = None) -> None:
        """Makes them so many, the last of them arbitrary: for values that are written next."""
        if count < self.count:
            self.keep(torch.arange(count, device=self.means.device), optimizer)
        elif count > self.count:
            more = count - self.count
            self.append({name: old.new_zeros(more, *old.shape[1:]) for name, old in self.tensors().items()}, optimizer)

    def overwrite(
        self, rows: dict[str, Tensor], index: Tensor | None = None, optimizer: Optimizer | None = None
    ) -> None:
        """Writes values of some parameters in place, at an index or mask [N] or everywhere, and zeroes the optimizer
        state there."""
        where = slice(None) if index is None else index
        for name, values in rows.items():
            getattr(self, name).detach()[where] = values
            self.forget(name, where, optimizer)

    def forget(self, name: str, where, optimizer: Optimizer | None) -> None:
        """Zeroes a parameter's optimizer state at an index, mask or slice."""
        for state in moments_of(optimizer, getattr(self, name)).values():
            state[where] = 0

    def _put(self, name: str, new: nn.Parameter, moments: dict[str, Tensor], optimizer: Optimizer | None) -> None:
        """Puts a parameter in the place of the one of this name, with its moments."""
        old = getattr(self, name)
        setattr(self, name, new)
        if optimizer is None:
            return
        for group in optimizer.param_groups:
            group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
        if old in optimizer.state:
            optimizer.state[new] = optimizer.state.pop(old) | moments

    def _tell(self) -> None:
        """The device how many there are."""
        if self._spare is not None:
            self._spare.live.fill_(self.count)


def neighbour_distances(points: Tensor) -> Tensor:
    """[N, 3] float64: exact distances from each point to its three nearest others. Raises SehdrError for a point that
    is not finite."""
    positions = points.detach().double().cpu().numpy()
    broken = np.flatnonzero(~np.isfinite(positions).all(1))
    if len(broken):
        problem = f"point {broken[0]} of {len(points)} is {positions[broken[0]].tolist()}"
        raise SehdrError(f"{problem}: a point cloud needs finite coordinates; remove such points")
    from scipy.spatial import KDTree

    tree = KDTree(positions, balanced_tree=False, compact_nodes=False)
    distances = np.empty((len(positions), 4))
    # In the tree's own order, in which queries that follow each other read the same nodes.
    distances[tree.indices], _ = tree.query(positions[tree.indices], k=4, workers=thread_count())
    return torch.from_numpy(distances[:, 1:])
