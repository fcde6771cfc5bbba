"""Differentiable splatting of 3D Gaussians: project, order, bin, blend."""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..kernels.constants import ALPHA_THRESHOLD, EPS2D, NEAR_PLANE
from .blending import blend, with_gradient
from .checks import check_opacities, check_tensors, integer
from .graph_cache import Frame, Given, replayed
from .memory import oom_context
from .projection import project
from .tile_lists import MAX_INTERSECTIONS, build_tile_lists, order_intersections, pack_gaussians

LARGEST_SIDE = 1 << 20  # of an image, in pixels


@dataclass(frozen=True)
class Rendering:
    """One rendered view of N Gaussians; of B cameras in one call all but the last three begin with an axis of B.

    Attributes:
        image: [H, W, C] blended features over the background, or over zero.
        transmittance: [H, W] in [0, 1], how much of each pixel's background is seen. The backward pass reads it: do not
            write to it.
        means2d: [N, 2] centres in pixels; part of the graph, so means2d.retain_grad() gives densification its signal.
        depths: [N] along the camera's axis, in scene units; 0 where culled.
        extents: [N, 2] half-width and half-height in pixels within which a Gaussian counts; 0 where culled.
        intersection_count: (Gaussian, tile) pairs that there was room for.
        overflow: scalar bool tensor, whether the given max_intersections left some of them out; None without a
        max_intersections.
        needed_intersections: scalar int64 tensor, how many there are; None without a max_intersections.
        depth: [H, W] blended depths along the camera's axis over zero, where they were asked for; over alpha they are
            the expected depth.
    """

    image: Tensor
    transmittance: Tensor
    means2d: Tensor
    depths: Tensor
    extents: Tensor
    intersection_count: int
    overflow: Tensor | None = None
    needed_intersections: Tensor | None = None
    depth: Tensor | None = None

    @property
    def alpha(self) -> Tensor:
        """[H, W] in [0, 1], how much of each pixel the Gaussians cover; made anew whenever it is asked for."""
        return 1.0 - self.transmittance

    @property
    def radii(self) -> Tensor:
        """[N] the longer of the two half-extents; made anew whenever it is asked for."""
        return self.extents.amax(dim=-1)

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
    near_plane: float = NEAR_PLANE,
    eps2d: float = EPS2D,
    alpha_threshold: float = ALPHA_THRESHOLD,
    antialiased: bool = False,
    background: Tensor | None = None,
    depth: bool = False,
    max_intersections: int | None = None,
    deterministic: bool = False,
) -> Rendering:
    """Splat Gaussians with any number of feature channels onto cameras' image planes (3DGS, Kerbl et al. 2023).

    All tensors share one device (CPU or CUDA) and one dtype (float32 or float64). Differentiable with respect to every
    tensor, camera included. On the CPU results repeat bit for bit, whatever the number of threads. A Gaussian whose
    position or shape in the image, or a feature, is not finite is culled; a camera that is not finite culls them all.
    Warns on the CPU of log_scales that look like sizes.

    B cameras in one call: world_to_camera [B, 4, 4], intrinsics [B, 4]; features may then be [B, N, C], opacities [B,
    N].

    Args:
        means: [N, 3] world coordinates.
        log_scales: [N, 3] natural logarithm of the standard deviations along the local axes, in scene units.
        quaternions: [N, 4] (w, x, y, z), of any length.
        opacities: [N] in [0, 1].
        features: [N, C], any C >= 1 and any finite range; several color sets go side by side in one pass.
        world_to_camera: [4, 4], OpenCV convention.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        width: of the image, pixels.
        height: likewise.
        near_plane: points nearer to the camera plane are culled; > 0.
        eps2d: variance in square pixels added to each splat; >= 0.
        alpha_threshold: contributions below it are left out, in (0, 1).
        antialiased: keep a Gaussian's energy under the low pass by lowering its opacity.
        background: [C] what shows through, or with B cameras [B, C].
        depth: also blend depths, Rendering.depth.
        max_intersections: room for this many (Gaussian, tile) pairs of a camera, from 1. On a GPU nothing then waits
            for the device, so that the call can be part of a CUDA graph; Rendering.overflow says whether the room was
            enough.
        deterministic: on a GPU, sum gradients in a fixed order, so that the same input gives the same bits; slower, and
            the gradients of every (Gaussian, tile) pair take memory.

    Raises:
        TypeError: for what is no tensor or no whole number.
        ValueError: for shapes, dtypes, devices or options that do not fit, and on the CPU for opacities outside of [0,
            1].
        OutOfMemory: (an SehdrError), with the sizes, if memory does not suffice.
    """
    cameras: tuple[str, ...] = ("B",) if isinstance(world_to_camera, Tensor) and world_to_camera.ndim == 3 else ()
    by_camera = [bool(cameras) and isinstance(t, Tensor) and t.ndim == n for t, n in ((opacities, 2), (features, 3))]
    backgrounds = {} if background is None else {"background": (background, (*cameras[: background.ndim - 1], "C"))}
    check_tensors(
        means=(means, ("N", 3)),
        log_scales=(log_scales, ("N", 3)),
        quaternions=(quaternions, ("N", 4)),
        opacities=(opacities, (*cameras[: by_camera[0]], "N")),
        features=(features, (*cameras[: by_camera[1]], "N", "C")),
        world_to_camera=(world_to_camera, (*cameras, 4, 4)),
        intrinsics=(intrinsics, (*cameras, 4)),
        **backgrounds,
    )
    channels = features.shape[-1]
    if not channels:
        raise ValueError(f"features has shape {list(features.shape)}, expected [N, C] with C >= 1")
    check_opacities(opacities)
    width = integer("width", width, 1, LARGEST_SIDE)
    height = integer("height", height, 1, LARGEST_SIDE)
    if max_intersections is not None:
        max_intersections = integer("max_intersections", max_intersections, 1, MAX_INTERSECTIONS)
    if not 0.0 < near_plane < math.inf:
        raise ValueError(f"near_plane {near_plane} is not a positive number")
    if not 0.0 <= eps2d < math.inf:
        raise ValueError(f"eps2d {eps2d} is not a number from 0")
    if not 0.0 < alpha_threshold < 1.0:
        raise ValueError(f"alpha_threshold {alpha_threshold} is not between 0 and 1")

    launched = max_intersections is not None or deterministic  # and never replayed

    def projected(opacities: Tensor, pose: Tensor, lens: Tensor) -> tuple[Tensor, ...]:
        tensors = (tensor.contiguous() for tensor in (means, log_scales, quaternions, opacities, pose, lens))
        options = {
            "near_plane": near_plane,
            "eps2d": eps2d,
            "alpha_threshold": alpha_threshold,
            "antialiased": antialiased,
        }
        return project(*tensors, width=width, height=height, **options)

    def drawn(features: Tensor, means2d, conics, depths, opacities, extents) -> Rendering:
        features = (torch.cat([features, depths[:, None]], 1) if depth else features).contiguous()
        leaves = means2d, conics, opacities, features
        given = Given(
            means2d.detach(), conics.detach(), opacities.detach(), features.detach(), depths.detach(), extents
        )
        differentiable = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in leaves)
        again = None if launched else replayed(given, Frame(width, height, alpha_threshold), differentiable)
        if again:
            picture, pairs = again
            image, transmittance = with_gradient(*leaves, picture)
            numbers = pairs, None, None
        else:
            records, counts = pack_gaussians(*given[:3], extents, alpha_threshold, width, height, given.features)
            unsorted = features.device.type == "cpu" or deterministic
            numbered = order_intersections(counts, given.depths, extents, unsorted=unsorted)
            seen = records, *numbered, given.depths, extents, width, height
            lists = build_tile_lists(*seen, max_intersections, unsorted=unsorted)
            image, transmittance = blend(*leaves, lists, records, alpha_threshold, deterministic)
            numbers = lists.intersection_count, lists.overflow, None if max_intersections is None else lists.total
        last = image[..., -1] if depth else None
        image = image[..., :-1] if depth else image
        return Rendering(image, transmittance, means2d, depths, extents, *numbers, last)

    with oom_context(means.device, lambda: (len(means), width, height, channels)):
        if cameras:
            count = len(world_to_camera)
            if not count:
                raise ValueError("world_to_camera has no camera, expected [B, 4, 4] with B >= 1")
            opacities, features = (
                tensor if own else tensor.expand(count, *tensor.shape)
                for tensor, own in zip((opacities, features), by_camera, strict=True)
            )
            seen = [projected(*each) for each in zip(opacities, world_to_camera, intrinsics, strict=True)]
            # One tensor that every picture is drawn from, so that its gradient holds every camera's.
            means2d = torch.stack([each[0] for each in seen])
            each_seen = zip(features, means2d, seen, strict=True)
            rendering = joined(means2d, [drawn(mine, own, *each[1:]) for mine, own, each in each_seen])
        else:
            rendering = drawn(features, *projected(opacities, world_to_camera, intrinsics))
        if background is None:
            return rendering
        shown = background[:, None, None] if background.ndim == 2 else background
        return replace(rendering, image=rendering.image + rendering.transmittance[..., None] * shown)


def joined(means2d: Tensor, renderings: list[Rendering]) -> Rendering:
    """One rendering of the cameras' own, drawn from means2d [B, N, 2]."""

    def stacked(name: str) -> Any:
        values = [getattr(rendering, name) for rendering in renderings]
        return None if values[0] is None else torch.stack(values)

    overflow, pairs = stacked("overflow"), stacked("needed_intersections")
    return Rendering(
        stacked("image"), stacked("transmittance"), means2d, stacked("depths"), stacked("extents"),
        sum(rendering.intersection_count for rendering in renderings), None if overflow is None else overflow.any(),
        None if pairs is None else pairs.sum(), stacked("depth"),
    )  # fmt: skip
