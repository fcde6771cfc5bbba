"""Differentiable splatting of 3D Gaussians: project, order, bin, blend."""

import math
from dataclasses import dataclass

import torch

from ..kernels.constants import ALPHA_THRESHOLD, LOW_PASS, NEAR
from .blending import DEFAULT_STYLE, BlendStyle, blend
from .memory import tells_sizes
from .projection import project
from .tile_lists import LARGEST_CAPACITY, build_tile_lists, pack_records


@dataclass(frozen=True)
class Rendering:
    """One rendered view of N Gaussians.

    image: [H, W, C] blended features over zero; add transmittance * background for another background.
    transmittance: [H, W] in [0, 1], how much of each pixel's background is seen. The backward pass reads it: do not
        write to it.
    means2d: [N, 2] centres in pixels; part of the graph, so means2d.retain_grad() gives densification its signal.
    depths: [N] along the camera's axis, in scene units; 0 where culled.
    radii: [N] the longer half-extent in pixels within which a Gaussian counts; 0 where culled.
    entry_count: (Gaussian, tile) pairs that there was room for.
    overflow: scalar bool tensor, whether the given capacity left some of them out; None without a capacity.
    pair_count: scalar int64 tensor, how many there are; None from rasterizers that do not count them.
    """

    image: torch.Tensor
    transmittance: torch.Tensor
    means2d: torch.Tensor
    depths: torch.Tensor
    radii: torch.Tensor
    entry_count: int
    overflow: torch.Tensor | None = None
    pair_count: torch.Tensor | None = None

    @property
    def alpha(self) -> torch.Tensor:
        """[H, W] in [0, 1], how much of each pixel the Gaussians cover; made anew whenever it is asked for."""
        return 1.0 - self.transmittance

    @property
    def visible(self) -> torch.Tensor:
        """[N] bool: not culled."""
        return self.radii > 0


@tells_sizes
def rasterize(
    means: torch.Tensor,
    log_scales: torch.Tensor,
    quaternions: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
    world_to_camera: torch.Tensor,
    intrinsics: torch.Tensor,
    width: int,
    height: int,
    *,
    near: float = NEAR,
    low_pass: float = LOW_PASS,
    alpha_threshold: float = ALPHA_THRESHOLD,
    antialiased: bool = False,
    capacity: int | None = None,
    style: BlendStyle = DEFAULT_STYLE,
) -> Rendering:
    """Splat Gaussians with any number of feature channels onto one camera's image plane (3DGS, Kerbl et al. 2023).

    means: [N, 3] world coordinates.
    log_scales: [N, 3] natural logarithm of the standard deviations along the local axes, in scene units.
    quaternions: [N, 4] (w, x, y, z), of any length.
    opacities: [N] in [0, 1].
    features: [N, C], any C >= 1 and any finite range; several colour sets go side by side in one pass.
    world_to_camera: [4, 4], OpenCV convention. intrinsics: [4] fx, fy, cx, cy in pixels. width, height: in pixels.
    near: points nearer to the camera plane are culled; > 0. low_pass: variance in square pixels added to each splat;
        >= 0.
    alpha_threshold: contributions below it are left out, in (0, 1).
    antialiased: keep a Gaussian's energy under the low pass by lowering its opacity.
    capacity: room for this many (Gaussian, tile) pairs, from 1. On a GPU nothing then waits for the device, so that the
        call can be part of a CUDA graph; Rendering.overflow says whether the room was enough.
    style: what trades exactness and repeatability for speed; BlendStyle(deterministic=True) repeats bits on a GPU.

    All tensors share one device (CPU or CUDA) and one dtype (float32 or float64). Differentiable with respect to
    every tensor, camera included. On the CPU results repeat bit for bit, whatever the number of threads.
    A Gaussian whose position or shape in the image, or a feature, is not finite is culled; a camera that is not finite
    culls them all.
    Raises ValueError for shapes, dtypes, devices or values that do not fit; OutOfMemory (an SehdrError), with the
    sizes, if memory does not suffice.
    """
    _check_tensors(means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics)
    _check_options(width, height, near, low_pass, alpha_threshold, capacity)
    tensors = (means, log_scales, quaternions, opacities, world_to_camera, intrinsics)
    means2d, conics, depths, opacities2d, extents = project(
        *(tensor.contiguous() for tensor in tensors),
        width=width,
        height=height,
        near=near,
        low_pass=low_pass,
        alpha_threshold=alpha_threshold,
        antialiased=antialiased,
    )
    features = features.contiguous()
    records = pack_records(
        *(tensor.detach() for tensor in (means2d, conics, opacities2d)), extents, alpha_threshold, features.detach()
    )
    lists = build_tile_lists(
        records,
        depths.detach(),
        extents,
        width,
        height,
        capacity,
        emission=means.device.type == "cpu" or style.deterministic,
    )
    image, transmittance = blend(
        means2d,
        conics,
        opacities2d,
        features,
        lists=lists,
        records=records,
        extents=extents,
        width=width,
        height=height,
        alpha_threshold=alpha_threshold,
        style=style,
    )
    radii = extents.amax(dim=1)
    return Rendering(image, transmittance, means2d, depths, radii, lists.entry_count, lists.overflow, lists.total)


def _check_tensors(means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics) -> None:
    count = means.shape[0] if means.ndim else 0
    shapes = {
        "means": (means, (count, 3)),
        "log_scales": (log_scales, (count, 3)),
        "quaternions": (quaternions, (count, 4)),
        "opacities": (opacities, (count,)),
        "world_to_camera": (world_to_camera, (4, 4)),
        "intrinsics": (intrinsics, (4,)),
    }
    for name, (tensor, shape) in shapes.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")
    if features.ndim != 2 or features.shape[0] != count or features.shape[1] < 1:
        raise ValueError(f"features has shape {tuple(features.shape)}, expected ({count}, C) with C >= 1")
    for name, (tensor, _) in {**shapes, "features": (features, None)}.items():
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ValueError(
                f"{name} is {tensor.dtype} on {tensor.device}, but means is {means.dtype} on {means.device}"
            )
    if means.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"means is {means.dtype}, expected torch.float32 or torch.float64")


def _check_options(width, height, near, low_pass, alpha_threshold, capacity) -> None:
    if width < 1 or height < 1:
        raise ValueError(f"image size {width} x {height} is not positive")
    if not 0.0 < near < math.inf:
        raise ValueError(f"near {near} is not a positive number")
    if not 0.0 <= low_pass < math.inf:
        raise ValueError(f"low_pass {low_pass} is not a number from 0")
    if not 0.0 < alpha_threshold < 1.0:
        raise ValueError(f"alpha_threshold {alpha_threshold} is not between 0 and 1")
    if capacity is not None and not 1 <= capacity <= LARGEST_CAPACITY:
        raise ValueError(f"capacity {capacity} is not in 1..{LARGEST_CAPACITY}")
