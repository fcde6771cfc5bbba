"""Differentiable splatting of 3D Gaussians: project, order, bin, blend."""

import math
from dataclasses import dataclass

from torch import Tensor

from ..kernels.constants import ALPHA_THRESHOLD, LOW_PASS, NEAR
from .blending import blend
from .checks import check_opacities, check_tensors, whole_number
from .memory import memory_told
from .projection import project
from .tile_lists import LARGEST_CAPACITY, build_tile_lists, pack_records

LARGEST_SIDE = 1 << 20  # of an image, in pixels


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

    image: Tensor
    transmittance: Tensor
    means2d: Tensor
    depths: Tensor
    radii: Tensor
    entry_count: int
    overflow: Tensor | None = None
    pair_count: Tensor | None = None

    @property
    def alpha(self) -> Tensor:
        """[H, W] in [0, 1], how much of each pixel the Gaussians cover; made anew whenever it is asked for."""
        return 1.0 - self.transmittance

    @property
    def visible(self) -> Tensor:
        """[N] bool: not culled."""
        return self.radii > 0


def rasterize(
    means: Tensor,
    log_scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    features: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    width: int,
    height: int,
    *,
    near: float = NEAR,
    low_pass: float = LOW_PASS,
    alpha_threshold: float = ALPHA_THRESHOLD,
    antialiased: bool = False,
    capacity: int | None = None,
    deterministic: bool = False,
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
    deterministic: on a GPU, sum gradients in a fixed order, so that the same input gives the same bits; slower, and the
        gradients of every (Gaussian, tile) pair take memory.

    All tensors share one device (CPU or CUDA) and one dtype (float32 or float64). Differentiable with respect to
    every tensor, camera included. On the CPU results repeat bit for bit, whatever the number of threads.
    A Gaussian whose position or shape in the image, or a feature, is not finite is culled; a camera that is not finite
    culls them all.
    Raises TypeError for what is no tensor or no whole number, ValueError for shapes, dtypes, devices or options that do
    not fit, and on the CPU for opacities outside of [0, 1]; OutOfMemory (an SehdrError), with the sizes, if memory does
    not suffice. Warns on the CPU of log_scales that look like sizes.
    """
    check_tensors(
        means=(means, ("N", 3)),
        log_scales=(log_scales, ("N", 3)),
        quaternions=(quaternions, ("N", 4)),
        opacities=(opacities, ("N",)),
        features=(features, ("N", "C")),
        world_to_camera=(world_to_camera, (4, 4)),
        intrinsics=(intrinsics, (4,)),
    )
    if not features.shape[1]:
        raise ValueError(f"features has shape {list(features.shape)}, expected [N, C] with C >= 1")
    check_opacities(opacities)
    width = whole_number("width", width, 1, LARGEST_SIDE)
    height = whole_number("height", height, 1, LARGEST_SIDE)
    if capacity is not None:
        capacity = whole_number("capacity", capacity, 1, LARGEST_CAPACITY)
    if not 0.0 < near < math.inf:
        raise ValueError(f"near {near} is not a positive number")
    if not 0.0 <= low_pass < math.inf:
        raise ValueError(f"low_pass {low_pass} is not a number from 0")
    if not 0.0 < alpha_threshold < 1.0:
        raise ValueError(f"alpha_threshold {alpha_threshold} is not between 0 and 1")
    tensors = (means, log_scales, quaternions, opacities, world_to_camera, intrinsics)
    with memory_told(means.device, lambda: (len(means), width, height, features.shape[1])):
        options = {"near": near, "low_pass": low_pass, "alpha_threshold": alpha_threshold, "antialiased": antialiased}
        means2d, conics, depths, opacities2d, extents = project(
            *(tensor.contiguous() for tensor in tensors), width=width, height=height, **options
        )
        features = features.contiguous()
        means_, conics_, opacities_ = (tensor.detach() for tensor in (means2d, conics, opacities2d))
        records = pack_records(means_, conics_, opacities_, extents, alpha_threshold, features.detach())
        emission = means.device.type == "cpu" or deterministic
        lists = build_tile_lists(records, depths.detach(), extents, width, height, capacity, emission=emission)
        given = means2d, conics, opacities2d, features, extents
        image, transmittance = blend(*given, lists, records, alpha_threshold, deterministic)
        radii = extents.amax(dim=1)
    return Rendering(image, transmittance, means2d, depths, radii, lists.entry_count, lists.overflow, lists.total)
