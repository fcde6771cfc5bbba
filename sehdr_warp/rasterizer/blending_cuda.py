"""Blend on a GPU by block kernels, and the backward pass of that."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..errors import SehdrError
from ..kernels import blend_cuda, blend_cuda_backward
from .gradients import sum_by_gaussian
from .tile_lists import MAX_SINGLE_SORT, PackedSplats, TileLists
from .warp_launch.launching import FixedLaunch, fixed_launch, launch, warp_scalar


def blend_on_cuda(
    features: Tensor,
    lists: TileLists,
    packed: PackedSplats,
    image: Tensor,
    transmittance: Tensor,
    alpha_threshold: float,
    deterministic: bool,
    *,
    keeps_padded: bool = False,
) -> "BlockBackward":
    """Fill image [H, W, C] and transmittance [H, W] by block kernels (in tests also in Warp's CPU block emulation).

    keeps_padded: let the backward pass read the padded features of this call, as on_fixed_memory() needs.
    """
    padded = pad_features(features) if packed.padded is None else packed.padded
    kernel, arguments = _forward(padded, lists, packed, image, transmittance, alpha_threshold)
    launch_blocks(kernel, lists, blend_cuda.BLOCKS_PER_TILE, *arguments)
    # Padded features take more memory. The backward pass pads those of many Gaussians again.
    features = padded if keeps_padded or len(features) <= MAX_SINGLE_SORT else features
    return BlockBackward(
        features, image.shape[-1], lists, packed[:2], transmittance, arguments[-1], alpha_threshold, deterministic
    )


@dataclass(frozen=True)
class BlockBackward:
    """The backward pass of blend_on_cuda(); see blending.py."""

    features: Tensor  # [N, C] or, padded, [N, more]
    channels: int
    lists: TileLists
    ellipses: tuple[Tensor, Tensor]  # The first two of PackedSplats, all of it that is still read
    transmittance: Tensor  # [H, W], the result
    last_contributor: Tensor  # [H W] int32, 1 + the index of a pixel's last Gaussian in its tile's list, or 0
    alpha_threshold: float
    deterministic: bool

    def __call__(self, grad_image: Tensor, grad_transmittance: Tensor | None) -> Tensor:
        """Return a row of gradients for each Gaussian."""
        lists = self.lists
        if not self.deterministic:
            gradients = self._zeros()
            arguments = *self._arguments(grad_image, grad_transmittance), 0, lists.gaussians, gradients
            launch_blocks(self._kernel(), lists, blend_cuda.BLOCKS_PER_TILE, *arguments)
            return gradients
        columns = self.channels + 6
        if lists.intersection_count * columns >= 1 << 31:
            raise SehdrError(
                f"{lists.intersection_count} intersections with {self.channels} channels have 2^31 gradients or more, "
                "which deterministic=True keeps; render without it, or fewer Gaussians or a smaller image"
            )
        grad_intersections = self.transmittance.new_zeros(lists.intersection_count, columns)
        emit_order, arguments = lists.emit_order, self._arguments(grad_image, grad_transmittance)
        assert emit_order is not None, "sums in a fixed order need the intersections as they were emitted"
        for subtile in range(blend_cuda.BLOCKS_PER_TILE):
            launch_blocks(self._kernel(), lists, 1, *arguments, subtile, lists.emit_indices, grad_intersections)
        return sum_by_gaussian(grad_intersections, *emit_order)

    def on_fixed_memory(self) -> "FixedBackward":
        """Return the backward pass for less host time; for use while all tensors stay where they are.

        features are padded, or the backward pass would read what they were at this call. Each launch gives addresses:
        of the gradients of image and transmittance (0 for none), and of the rows of Gaussians, zeros to add to.
        """
        assert not self.deterministic, "sums in a fixed order are several launches"
        grad_image = self.transmittance.new_empty(*self.transmittance.shape, self.channels)
        grad_transmittance, gradients = torch.empty_like(self.transmittance), self._zeros()
        fixed = fixed_launch(
            self._kernel(),
            block_threads(self.lists, blend_cuda.BLOCKS_PER_TILE),
            *self._arguments(grad_image, grad_transmittance),
            0,
            self.lists.gaussians,
            gradients,
            by_address=(grad_image, grad_transmittance, gradients),
            block_dim=blend_cuda.BLOCK_DIM,
        )
        return FixedBackward(fixed, gradients)

    @property
    def columns(self) -> int:
        """Number of columns of the gradients."""
        columns = self.channels + 6
        if blend_cuda_backward.adds_quads(warp_scalar(self.features.dtype), self.deterministic, self._cuda):
            columns = blend_cuda.padded_channels(columns)
        return columns

    def _zeros(self) -> Tensor:
        return self.transmittance.new_zeros(len(self.features), self.columns)

    @property
    def _cuda(self) -> bool:
        return self.features.device.type == "cuda"

    def _kernel(self) -> Any:
        scalar = warp_scalar(self.features.dtype)
        return blend_cuda_backward.backward_kernel(scalar, self.channels, self.deterministic, self._cuda)

    def _arguments(self, grad_image: Tensor, grad_transmittance: Tensor | None) -> tuple:
        padded = pad_features(self.features)
        inputs = _inputs(padded, self.lists, self.ellipses, self.transmittance, self.alpha_threshold)
        outputs_and_gradients = self.transmittance, self.last_contributor, grad_image, grad_transmittance
        return *inputs, *outputs_and_gradients, blend_cuda_backward.LINES, self.channels + 6


class FixedBackward(NamedTuple):
    """A BlockBackward whose tensors stay where they are, but for the gradients."""

    fixed: FixedLaunch  # Its launch
    gradients: Tensor  # A tensor like the rows that BlockBackward returns


def fixed_blend_blocks(
    padded: Tensor, lists: TileLists, packed: PackedSplats, image: Tensor, transmittance: Tensor, alpha_threshold: float
) -> FixedLaunch:
    """Return the launch of blend_on_cuda(), whose tensors stay where they are but for image and transmittance."""
    kernel, arguments = _forward(padded, lists, packed, image, transmittance, alpha_threshold)
    threads = block_threads(lists, blend_cuda.BLOCKS_PER_TILE)
    return fixed_launch(kernel, threads, *arguments, by_address=(image, transmittance), block_dim=blend_cuda.BLOCK_DIM)


def _forward(padded, lists, packed, image, transmittance, alpha_threshold) -> tuple[Any, tuple[Any, ...]]:
    """Return the forward kernel and its arguments, of which the last is BlockBackward.last_contributor."""
    kernel = blend_cuda.forward_kernel(warp_scalar(padded.dtype), image.shape[2], padded.device.type == "cuda")
    last_contributor = torch.empty(transmittance.numel(), dtype=torch.int32, device=padded.device)
    inputs = _inputs(padded, lists, packed[:2], transmittance, alpha_threshold)
    return kernel, (*inputs, image, transmittance, last_contributor)


def _inputs(padded, lists, ellipses, transmittance, alpha_threshold) -> tuple[Any, ...]:
    """Return the arguments that both kernels take first."""
    assert lists.subtile_masks is not None, "block kernels need lists with subtile_masks"
    height, width = transmittance.shape
    return (
        *(lists.tile_ranges, lists.gaussians, lists.subtile_masks, *ellipses, padded.reshape(-1, 4)),
        *(lists.grid.columns, width, height, alpha_threshold),
    )


def launch_blocks(kernel: Any, lists: TileLists, blocks_per_tile: int, *arguments: Any) -> None:
    """Launch a block kernel over the tiles."""
    launch(kernel, block_threads(lists, blocks_per_tile), *arguments, block_dim=blend_cuda.BLOCK_DIM)


def block_threads(lists: TileLists, blocks_per_tile: int) -> int:
    """Return the number of threads of a block kernel over the tiles."""
    return lists.grid.tiles * blocks_per_tile * blend_cuda.BLOCK_DIM


def pad_features(features: Tensor) -> Tensor:
    """Return features [N, C] with columns of zeros to a multiple of four: block kernels read four numbers at once."""
    channels = features.shape[1]
    if channels != (columns := blend_cuda.padded_channels(channels)):
        return torch.nn.functional.pad(features, (0, columns - channels))
    return features.clone() if features.data_ptr() % 16 else features
