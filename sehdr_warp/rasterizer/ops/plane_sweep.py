"""A plane sweep over posed photos as an operation on either device (kernels/plane_sweep.py)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...kernels import plane_sweep, plane_sweep_cpu
from ..warp_launch.launching import launch

BORDER = int(plane_sweep.RADIUS)
"""Pixels nearer to the border than this cannot be matched: a patch would leave the photo."""
NEIGHBORS = plane_sweep.MOST_NEIGHBORS  # Largest number of photos that a photo is compared with


@dataclass(frozen=True)
class PhotoSet:
    """Posed photos of any sizes, one after another on a device, each with the neighbors that it is compared with.

    codes: [P, 4] all pixels, uint8: RGB and a 0, so that one is read at once. offsets: [V] int64; sizes: [V, 2] int32;
    intrinsics: [V, 4]; neighbors: [V, K] int32, -1 for none; between: [V, K, 4, 4], from a view's axes to a neighbor's.
    """

    codes: Tensor
    offsets: Tensor
    sizes: Tensor
    intrinsics: Tensor
    neighbors: Tensor
    between: Tensor

    @staticmethod
    def of(photos: Sequence[np.ndarray], cameras: Sequence, neighbors: np.ndarray, device: torch.device | str):
        """Return the set of photos, uint8 [H, W, 3], with a scene.Camera each and neighbors [V, K], -1 for none."""
        poses = np.stack([camera.world_to_camera for camera in cameras])
        back = np.stack([camera.camera_to_world for camera in cameras])
        starts = np.cumsum([0, *(photo.shape[0] * photo.shape[1] for photo in photos)])
        codes = np.zeros((starts[-1], 4), np.uint8)
        np.concatenate([photo.reshape(-1, 3) for photo in photos], out=codes[:, :3])
        arrays = {
            "codes": codes,
            "offsets": starts[:-1].astype(np.int64),
            "sizes": np.array([[camera.width, camera.height] for camera in cameras], np.int32),
            "intrinsics": np.stack([camera.intrinsics for camera in cameras]).astype(np.float32),
            "neighbors": np.ascontiguousarray(neighbors, np.int32),
            "between": (poses[neighbors] @ back[:, None]).astype(np.float32),
        }
        return PhotoSet(**{name: torch.from_numpy(values).to(device) for name, values in arrays.items()})


@torch.no_grad()
def matching_costs(photos: PhotoSet, pixels: Tensor, depths: Tensor) -> Tensor:
    """Return matching costs [N, D] in [0, 0.25] of pixels at depths; 0.5 if fewer than two neighbors show the place.

    pixels: [N, 3] view, column, row; int32. depths: [N, D] float32, along the view's axis.
    """
    costs = torch.empty(depths.shape, device=depths.device)
    if depths.device.type == "cpu":
        kernel, threads = plane_sweep_cpu.sweep_rows, len(depths) * -(-depths.shape[1] // plane_sweep_cpu.LANES)
        codes = photos.codes.view(torch.int32)[:, 0]
    else:
        kernel, threads, codes = plane_sweep.sweep, depths.numel(), photos.codes
    views = photos.offsets, photos.sizes, photos.intrinsics, photos.neighbors, photos.between
    launch(kernel, threads, codes, *views, pixels.contiguous(), depths.contiguous(), costs)
    return costs


@torch.no_grad()
def trusted_depths(
    costs: Tensor, planes: Tensor, *, worst: float, margin: tuple[float, float], few: int, widest: float
) -> Tensor:
    """Return depths [N] by costs [N, D] of planes [D], D >= 3, farthest first; 0 if none is to be trusted.

    A depth is trusted if the least cost is below worst, and if costs below margin[0] times it plus margin[1] are those
    of fewer than `few` planes, or of depths within a factor of `widest`.
    """
    depths = torch.empty(len(costs), device=costs.device)
    launch(plane_sweep.trust_depths, len(costs), costs, planes, worst, *margin, few, widest, depths)
    return depths


@torch.no_grad()
def matched_points(photos: PhotoSet, poses: Tensor, pixels: Tensor, depths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return points [N, 3], colors [N, 3] in [0, 1] and footprints [N] of pixels [N, 3] at depths [N], all float32.

    poses: [V, 4, 4] from the views' axes to the world's. A footprint is what a pixel covers there.
    """
    points, colors = (depths.new_empty(len(depths), 3) for _ in range(2))
    footprints = torch.empty_like(depths)
    inputs = photos.codes, photos.offsets, photos.sizes, photos.intrinsics, poses, pixels.contiguous(), depths
    launch(plane_sweep.place_matches, len(depths), *inputs, points, colors, footprints)
    return points, colors, footprints
