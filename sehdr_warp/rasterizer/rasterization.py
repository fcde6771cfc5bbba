"""Differentiable rasterization of 3D Gaussians: project, order, list by tile, blend.

A call, from top to bottom: rasterize() checks its arguments. _begin_view() projects the Gaussians to a camera
(projection.py); they are called splats then. render_projected() packs the splats, orders them by depth, lists them by
tile (tile_lists.py), and blends the lists (blending.py).

On a GPU, a call like earlier ones is replayed as a CUDA graph instead (_begin_replay() and cuda_graphs/).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ..kernels.constants import ALPHA_THRESHOLD, EPS2D, NEAR_PLANE
from .absolute_gradient import watch_absolute_gradients
from .blending import blend, with_gradient
from .checks import check_cameras, check_channels, check_opacities, check_order_axis, check_tensors
from .cuda_graphs.cache import GraphInUse, GraphPool, checked_pool, pool_for
from .memory import oom_context
from .projection import GaussiansAndCamera, ProjectedGaussians, Splats2D, project_to_camera
from .render_options import RenderOptions
from .tile_lists import build_tile_lists, depths_along, order_gaussians, pack_splats
from .torch_contract import torch_operation


@dataclass(eq=False, repr=False)  # Not frozen, which would take as long as a launch.
class Rendering:
    """One rendered view of N Gaussians; for B cameras in one call, tensors begin with an axis of B unless noted.

    Attributes:
        image: [H, W, C] blended features over the background, or over zero.
        transmittance: [H, W] in [0, 1], how much of each pixel's background is visible.
        means2d: [N, 2] centers in pixels. They are part of the graph, so means2d.retain_grad() gives densification its
            signal.
        depths: [N] along the camera's axis, in scene units; 0 if culled.
        extents: [N, 2] half-width and half-height in pixels within which a Gaussian counts; 0 if culled.
        intersection_count: number of (Gaussian, tile) intersections of all cameras that memory was allocated for:
            max_intersections for each camera if that was given, else as many as there are.
        overflow: scalar bool, whether max_intersections was too few and some were left out; None without it.
        needed_intersections: scalar int64, how many there are, of all cameras; None without max_intersections.
        depth: [H, W] blended depths along the camera's axis over zero if depth was requested. Divided by alpha it is
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

    def __repr__(self) -> str:
        """Return the sizes in one line."""
        *cameras, height, width, channels = self.image.shape
        views = "".join(f"{count} cameras, " for count in cameras)
        parts = f"{width} x {height}, {channels} channels, {self.depths.shape[-1]:,} Gaussians, on {self.image.device}"
        return f"Rendering({views}{parts})"

    @property
    def alpha(self) -> Tensor:
        """[H, W] in [0, 1], how much of each pixel the Gaussians cover; computed at each access."""
        return 1.0 - self.transmittance

    @property
    def radii(self) -> Tensor:
        """[N] the longer of the two half-extents, in pixels; computed at each access."""
        return self.extents.amax(dim=-1)

    @property
    def visible(self) -> Tensor:
        """[N] bool, whether a Gaussian was not culled; computed at each access."""
        return self.radii > 0


@partial(torch_operation, compiles=True)  # Within torch.compile custom_ops.compiled_rasterize() takes its place.
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
    ray_limit_x: float = math.inf,
    ray_limit_y: float = math.inf,
    order_axis: Tensor | None = None,
) -> Rendering:
    """Rasterize Gaussians with any number of feature channels to images of cameras (3DGS, Kerbl et al. 2023).

    All tensors share one device (CPU or CUDA) and one dtype (float32 or float64). Differentiable once with respect to
    every tensor but order_axis, camera included; the graph can be retained. The factor that antialiased=True multiplies
    opacities by is constant in these gradients. On the CPU results repeat bit for bit, whatever the number of threads.

    A Gaussian with a parameter or feature that is not finite is culled: it contributes nothing, and its gradients are
    0. On a GPU a camera that is not finite culls all; on the CPU it is refused.

    B cameras in one call: world_to_camera [B, 4, 4], intrinsics [B, 4]; features may then be [B, N, C] and opacities
    [B, N].

    Args:
        means: [N, 3] world coordinates.
        log_scales: [N, 3] natural logarithm of the standard deviations along the local axes, in scene units.
        quaternions: [N, 4] (w, x, y, z), of any length.
        opacities: [N] in [0, 1].
        features: [N, C], any C >= 1 and any finite range. Several color sets can share one pass.
        world_to_camera: [4, 4], OpenCV convention.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        width: of the image, pixels.
        height: of the image, pixels.
        near_plane: least depth of a Gaussian's center, in scene units; > 0.
        eps2d: variance in square pixels added to each 2D Gaussian; >= 0.
        alpha_threshold: contributions with a smaller alpha are left out; between 1e-37 and 1.
        antialiased: lower opacities so that the variance of eps2d keeps a Gaussian's energy (Mip-Splatting).
            rasterize_directions() and compat.gsplat differentiate this factor, rasterize() does not.
        background: [C] color behind the Gaussians, or with B cameras [B, C].
        depth: also blend depths, see Rendering.depth.
        max_intersections: allocate memory for this many (Gaussian, tile) intersections of a camera, from 1. On a GPU
            the host then never waits for the device, so the call can be part of a CUDA graph. Rendering.overflow tells
            whether there were more.
        deterministic: on a GPU, sum the blend's gradients in a fixed order, as all others are, so that the same input
            gives the same bits. Slower, and the gradients of every intersection take memory.
        ray_limit_x: largest x/z at which the perspective is linearized; > 0. By default that of rays 30 % of half an
            image beyond its border, as in 3DGS. For an image that is wider than those that the Gaussians were trained
            on, the limit of these keeps Gaussians beside them from reaching into the middle.
        ray_limit_y: likewise y/z.
        order_axis: [3] of any length, in the camera's coordinates, along which Gaussians are ordered by depth; by
            default (0, 0, 1), the camera's own axis. A Gaussian that is not in front along it is first. On a GPU such
            calls are launched, and not replayed as CUDA graphs; an axis of 0 or that is not finite orders there as the
            camera's own.

    Raises:
        TypeError: if an argument is not a tensor or not an integer.
        ValueError: if a shape, dtype, device or option does not fit; on the CPU also for opacities outside of [0, 1]
            and for a camera that is not finite, cannot be inverted, is transposed or has a focal length that is not
            positive, and for an order_axis that is not finite or 0.
        NotImplementedError: within torch.func and for forward-mode differentiation.
        RuntimeError: while a CUDA graph is captured without max_intersections.
        OutOfMemory: (a SehdrError) with the sizes, if memory does not suffice.
    """
    rays = ray_limit_x, ray_limit_y
    options = RenderOptions(
        width, height, near_plane, eps2d, alpha_threshold, antialiased, depth, max_intersections, deterministic, *rays
    )
    tensors = GaussiansAndCamera(means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics)
    pool = checked_pool(tensors, options)  # Graphs of calls with these checked; None on the CPU
    if pool is None or background is not None or order_axis is not None:
        check_shapes(tensors, background, order_axis)
        check_opacities(opacities)
        check_cameras(world_to_camera, intrinsics)
        if order_axis is not None:
            check_order_axis(order_axis)
        options = options.checked(means.device)
    try:
        if world_to_camera.ndim == 2:
            pool = None if order_axis is not None else pool or pool_for(tensors, options)
            means2d, finish = _begin_view(tensors, options, pool, order_axis)
            rendering = finish(means2d)
        else:
            rendering = _render_cameras(tensors, options, order_axis)
        if background is not None:
            behind = background[:, None, None] if background.ndim == 2 else background
            rendering.image = rendering.image + rendering.transmittance[..., None] * behind
        return rendering
    except (RuntimeError, MemoryError):  # The context around all of it would take 2 us of each call.
        options.checked(means.device)  # It says what to do if the caller is capturing a CUDA graph.
        with oom_context(means.device, lambda: (len(means), width, height, features.shape[-1])):
            raise


def check_shapes(tensors: GaussiansAndCamera, background: Any, order_axis: Any = None) -> None:
    """Raise what rasterize() does for tensors whose shapes, dtypes or devices do not fit."""
    means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics = tensors

    def axes(tensor: Any, ndim: int) -> tuple[str, ...]:
        return ("B",) if isinstance(tensor, Tensor) and tensor.ndim == ndim else ()

    cameras = axes(world_to_camera, 3)
    optional: dict[str, tuple[Any, tuple]] = {}
    if background is not None:
        optional["background"] = background, (*(cameras and axes(background, 2)), "C")
    if order_axis is not None:
        optional["order_axis"] = order_axis, (3,)
    check_tensors(
        means=(means, ("N", 3)),
        log_scales=(log_scales, ("N", 3)),
        quaternions=(quaternions, ("N", 4)),
        opacities=(opacities, (*(cameras and axes(opacities, 2)), "N")),
        features=(features, (*(cameras and axes(features, 3)), "N", "C")),
        world_to_camera=(world_to_camera, (*cameras, 4, 4)),
        intrinsics=(intrinsics, (*cameras, 4)),
        **optional,
    )
    check_channels(features)
    if cameras and not len(world_to_camera):
        raise ValueError("world_to_camera has no camera, expected [B, 4, 4] with B >= 1")


def _begin_view(
    tensors: GaussiansAndCamera, options: RenderOptions, pool: GraphPool | None, order_axis: Tensor | None
) -> tuple[Tensor, Callable[[Tensor], Rendering]]:
    """Project to one camera; return means2d [N, 2], and a function that renders from them.

    The function is called with the tensor that the Rendering will hold: of several cameras a part of all means2d.
    pool: CUDA graphs of calls like this one; None if it is to be launched.
    """
    graph = None if pool is None else pool.begin_render(tensors, options)
    if graph is not None:
        return _begin_replay(graph, tensors, options)
    projected = project_to_camera(*tensors.without_features, options=options)
    features = tensors.features
    order = None if order_axis is None else depths_along(order_axis, projected, tensors.intrinsics)
    return projected.means2d, lambda means2d: render_projected(
        projected._replace(means2d=means2d), features, options, order_depths=order
    )


def _begin_replay(
    graph: GraphInUse, tensors: GaussiansAndCamera, options: RenderOptions
) -> tuple[Tensor, Callable[[Tensor], Rendering]]:
    """Do what _begin_view() does, but let a CUDA graph render all of it: also while the host waits in finish()."""
    blended, means2d, depths, extents, conics_opacities = graph.render(tensors)

    def finish(means2d: Tensor) -> Rendering:
        features = tensors.features
        if options.depth and torch.is_grad_enabled():  # The image has its depths; their gradient must go on to them.
            features = torch.cat([features, depths[:, None]], 1)
        image, transmittance = with_gradient(blended, features, means2d, conics_opacities)
        count = graph.count_intersections()  # Called last, because it waits for the GPU.
        if count is None:  # The graph has too little memory.
            projected = project_to_camera(*tensors.without_features, options=options)
            return render_projected(projected._replace(means2d=means2d), tensors.features, options)
        return _rendering(options, image, transmittance, means2d, depths, extents, count)

    return means2d, finish


def _render_cameras(tensors: GaussiansAndCamera, options: RenderOptions, order_axis: Tensor | None) -> Rendering:
    """Render to several cameras; opacities and features may have an axis of cameras too."""
    means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics = tensors
    count = len(world_to_camera)
    of_cameras = zip(
        opacities if opacities.ndim == 2 else [opacities] * count,
        features if features.ndim == 3 else [features] * count,
        world_to_camera,
        intrinsics,
        strict=True,
    )
    calls = [GaussiansAndCamera(means, log_scales, quaternions, *each) for each in of_cameras]
    pools = [None if order_axis is not None else pool_for(call, options) for call in calls]
    views = [_begin_view(call, options, pool, order_axis) for call, pool in zip(calls, pools, strict=True)]
    centers, finishes = zip(*views, strict=True)
    # One tensor that every image is rendered from, so that its gradient holds every camera's.
    means2d = torch.stack(centers)
    return join_renderings(means2d, [finish(part) for finish, part in zip(finishes, means2d, strict=True)])


def replay_projected(projected: ProjectedGaussians, features: Tensor, options: RenderOptions) -> Rendering | None:
    """Do what render_projected() does by a CUDA graph, of calls like it; None if there is none, as on the CPU."""
    splats = _to_splats(projected, features, options)
    pool = pool_for(splats, options) if splats.extents.is_contiguous() else None
    graph = None if pool is None else pool.begin_render(splats, options)
    if graph is None:
        return None
    means2d, conics, depths, opacities, extents = projected
    image, transmittance = with_gradient(graph.render_projected(splats), splats.features, conics, means2d, opacities)
    count = graph.count_intersections()
    return None if count is None else _rendering(options, image, transmittance, means2d, depths, extents, count)


def render_projected(
    projected: ProjectedGaussians,
    features: Tensor,
    options: RenderOptions,
    store_absolute: Callable[[Tensor], None] | None = None,
    order_depths: Tensor | None = None,
) -> Rendering:
    """Render 2D Gaussians of one camera with features [N, C].

    Sets the extents of Gaussians whose features are not finite to 0, in place.

    store_absolute: of watch_absolute_gradients(), for compat.gsplat. order_depths: [N] to order by, see depths_along().
    """
    splats = _to_splats(projected, features, options)
    if order_depths is not None:
        splats = splats._replace(depths=order_depths)
    width, height, threshold = options.width, options.height, options.alpha_threshold
    packed = pack_splats(splats, threshold, width, height)
    # Whether gradients are summed in a fixed order, as atomics of a GPU do not.
    in_order = features.device.type == "cpu" or options.deterministic
    emit_order = order_gaussians(packed, keep_emit_order=in_order)
    lists = build_tile_lists(packed, emit_order, width, height, options.max_intersections, keep_emit_order=in_order)
    image, transmittance = blend(splats, lists, packed, threshold, options.deterministic)
    if store_absolute is not None:
        image, transmittance = watch_absolute_gradients(
            image, transmittance, splats.features, lists, packed, threshold, store_absolute
        )
    needed = None if options.max_intersections is None else lists.total
    results = image, transmittance, projected.means2d, projected.depths, projected.extents
    return _rendering(options, *results, lists.intersection_count, lists.overflow, needed)


def _to_splats(projected: ProjectedGaussians, features: Tensor, options: RenderOptions) -> Splats2D:
    if options.depth:
        features = torch.cat([features, projected.depths[:, None]], 1)
    # extents.data: pack_splats() writes to it in place, which torch's check of saved tensors must not see.
    return Splats2D(*projected[:4], projected.extents.data, features.contiguous())


def _rendering(options: RenderOptions, image: Tensor, *others: Any) -> Rendering:
    """Return a Rendering of its first attributes; the last channel of the image is the depth if that was requested."""
    rendering = Rendering(image, *others)
    if options.depth:
        rendering.image, rendering.depth = image[..., :-1], image[..., -1]
    return rendering


def join_renderings(means2d: Tensor, renderings: list[Rendering]) -> Rendering:
    """Return one rendering with an axis of cameras of the cameras' own renderings, rendered from means2d [B, N, 2]."""

    def stack(name: str) -> Any:
        values = [getattr(rendering, name) for rendering in renderings]
        return None if values[0] is None else torch.stack(values)

    overflow, needed = stack("overflow"), stack("needed_intersections")
    return Rendering(
        image=stack("image"),
        transmittance=stack("transmittance"),
        means2d=means2d,
        depths=stack("depths"),
        extents=stack("extents"),
        intersection_count=sum(rendering.intersection_count for rendering in renderings),
        overflow=None if overflow is None else overflow.any(),
        needed_intersections=None if needed is None else needed.sum(),
        depth=stack("depth"),
    )
