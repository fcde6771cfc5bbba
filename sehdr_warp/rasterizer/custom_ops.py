"""Public operations within torch.compile and torch.export: custom operators of torch, with the shapes of their results.

Importing this module registers the operators; calls reach them only inside a compiler. The backward pass of an operator
renders once more, because an operator's results are tensors alone.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor

from ..kernels.constants import ALPHA_THRESHOLD, NEAR_PLANE
from .losses.ssim import ssim, ssim_map
from .ops.harmonics import check_harmonics, spherical_harmonics
from .projection import GaussiansAndCamera
from .rasterization import Rendering, check_shapes, rasterize
from .render_options import RenderOptions
from .sphere import rasterize_directions
from .torch_contract import HALF, register_compiled

Operation = Callable[..., list[Tensor]]


def _keys_of_thread() -> tuple[Any, Any]:
    return torch._C._dispatch_tls_local_include_set(), torch._C._dispatch_tls_local_exclude_set()


with ThreadPoolExecutor(1) as _executor:  # This thread may be importing within torch.inference_mode().
    _KEYS = _executor.submit(_keys_of_thread).result()
"""Dispatch keys of torch outside of an operator: within one it records no gradients."""


def register_custom_op(name: str, options: str, run: Operation, fake: Operation) -> Callable[..., list[Tensor]]:
    """Register an operator of torch, with its gradient, and return it.

    Args:
        name: without "sehdr_warp::".
        options: the schema's arguments after the tensors.
        run: takes a list of tensors, and options; returns tensors, differentiable.
        fake: returns tensors of the results' shapes.
    """

    def forward(tensors: Sequence[Tensor], *values: Any) -> list[Tensor]:
        with torch.no_grad():
            results = [result.contiguous() for result in run(tensors, *values)]
        # Color and depth of a single pixel are contiguous parts of one tensor, which torch refuses.
        memory = [result.untyped_storage().data_ptr() for result in results]
        return [result.clone() if memory.index(memory[k]) < k else result for k, result in enumerate(results)]

    def gradients_of(tensors: Sequence[Tensor], upstream: Sequence[Tensor | None], *values: Any) -> list[Tensor]:
        with torch._C._ForceDispatchKeyGuard(*_KEYS), torch.enable_grad():
            leaves = [tensor.detach().requires_grad_() for tensor in tensors]
            results = run(leaves, *values)
            places = [place for place, gradient in enumerate(upstream) if gradient is not None]
            places = [place for place in places if results[place].requires_grad]
            gradients: Sequence[Tensor | None] = [None] * len(leaves)
            if places:
                outputs, grad_outputs = [results[place] for place in places], [upstream[place] for place in places]
                gradients = torch.autograd.grad(outputs, leaves, grad_outputs, allow_unused=True)
        # Each with memory of its own, as a compiler may assume.
        pairs = zip(leaves, gradients, strict=True)
        return [torch.zeros_like(leaf) if gradient is None else gradient.clone() for leaf, gradient in pairs]

    schema = f"(Tensor[] tensors{options}) -> Tensor[]"
    node = torch.library.custom_op(f"sehdr_warp::{name}", forward, mutates_args=(), schema=schema)
    schema = f"(Tensor[] tensors, Tensor?[] upstream{options}) -> Tensor[]"
    adjoint = torch.library.custom_op(f"sehdr_warp::{name}_backward", gradients_of, mutates_args=(), schema=schema)
    node.register_fake(fake)
    adjoint.register_fake(lambda tensors, upstream, *values: [torch.empty_like(tensor) for tensor in tensors])

    def keep(ctx: Any, inputs: tuple, output: Any) -> None:
        tensors, *ctx.values = inputs
        ctx.save_for_backward(*tensors)

    def differentiate(ctx: Any, upstream: Sequence[Tensor | None]) -> tuple:
        gradients = adjoint(list(ctx.saved_tensors), list(upstream), *ctx.values)
        return gradients, *(None for _ in ctx.values)

    node.register_autograd(differentiate, setup_context=keep)
    return node


def _as_float(*tensors: Tensor) -> list[Tensor]:
    """Return the tensors as autocast leaves them; see torch_operation()."""
    if not all(isinstance(tensor, Tensor) for tensor in tensors):
        raise TypeError("an argument is not a torch tensor")  # The compiler then calls what names it.
    halves = [tensor.dtype in HALF and torch.is_autocast_enabled(tensor.device.type) for tensor in tensors]
    return [tensor.float() if half else tensor for tensor, half in zip(tensors, halves, strict=True)]


_NONE = 0, 0, 0, 0  # Shape of a tensor in the place of None


def _optional(tensor: Tensor) -> Tensor | None:
    return None if tensor.ndim == len(_NONE) and not tensor.numel() else tensor


def _run_rasterize(tensors: Sequence[Tensor], *options: Any) -> list[Tensor]:
    arguments: Any = tensors[:7]
    background, order_axis = map(_optional, tensors[7:])
    others: Any = {"background": background, "order_axis": order_axis}
    rendering = rasterize(*arguments, **others, **RenderOptions(*options)._asdict())
    results = [rendering.image, rendering.transmittance, rendering.means2d, rendering.depths, rendering.extents]
    optional = rendering.depth, rendering.overflow, rendering.needed_intersections
    return results + [result for result in optional if result is not None]


def _fake_rasterize(tensors: Sequence[Tensor], *values: Any) -> list[Tensor]:
    background, order_axis = map(_optional, tensors[7:])
    check_shapes(GaussiansAndCamera(*tensors[:7]), background, order_axis)
    options = RenderOptions(*values)
    height, width = options.height, options.width
    means, features, pose = tensors[0], tensors[4], tensors[5]
    cameras, count = pose.shape[:-2], means.shape[0]
    results = [
        means.new_empty(*cameras, height, width, features.shape[-1]),
        means.new_empty(*cameras, height, width),
        means.new_empty(*cameras, count, 2),
        means.new_empty(*cameras, count),
        means.new_empty(*cameras, count, 2),
    ]
    results += [means.new_empty(*cameras, height, width)] if options.depth else []
    if options.max_intersections is not None:
        results += [means.new_empty((), dtype=torch.bool), means.new_empty((), dtype=torch.int64)]
    return results


_rasterize_op = register_custom_op(
    "rasterize",  # The fields of RenderOptions, in their order.
    ", SymInt width, SymInt height, float near_plane, float eps2d, float alpha_threshold, bool antialiased, "
    "bool depth, SymInt? max_intersections, bool deterministic, float ray_limit_x, float ray_limit_y",
    _run_rasterize,
    _fake_rasterize,
)


def compiled_rasterize(
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
    background: Tensor | None = None,
    order_axis: Tensor | None = None,
    **others: Any,
) -> Rendering:
    """Do what rasterize() does, as a custom operator. The number of intersections is 0 without max_intersections."""
    cameras = len(world_to_camera) if world_to_camera.ndim == 3 else 1
    tensors = [means, log_scales, quaternions, opacities, features, world_to_camera, intrinsics]
    tensors += [means.new_empty(_NONE) if tensor is None else tensor for tensor in (background, order_axis)]
    options = RenderOptions(width, height, **others)
    results = _rasterize_op(_as_float(*tensors), *options)
    image, transmittance, means2d, depths, extents = results[:5]
    depth = results[5] if options.depth else None
    overflow, needed = (None, None) if options.max_intersections is None else results[-2:]
    count = cameras * (options.max_intersections or 0)
    return Rendering(image, transmittance, means2d, depths, extents, count, overflow, needed, depth)


def _run_directions(tensors: Sequence[Tensor], *values: Any) -> list[Tensor]:
    names = "focal_length", "pixel_angle", "antialiased", "near_plane", "alpha_threshold"
    directions, *axes = (tensor.detach() for tensor in tensors[6:])
    options: Any = dict(zip(names, values, strict=True)) | {"axes": axes[0] if axes else None}
    arguments: Any = *tensors[:6], directions
    return list(rasterize_directions(*arguments, **options))


_directions_op = register_custom_op(
    "rasterize_directions",
    ", float focal_length, float pixel_angle, bool antialiased, float near_plane, float alpha_threshold",
    _run_directions,
    lambda tensors, *options: [
        tensors[4].new_empty(*tensors[6].shape[:2], tensors[4].shape[1]),
        tensors[4].new_empty(tensors[6].shape[:2]),
    ],
)


def compiled_directions(
    means: Tensor,
    log_scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    features: Tensor,
    position: Tensor,
    directions: Tensor,
    *,
    focal_length: float,
    pixel_angle: float = 0.0,
    antialiased: bool = False,
    near_plane: float = NEAR_PLANE,
    alpha_threshold: float = ALPHA_THRESHOLD,
    axes: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Do what rasterize_directions() does, as a custom operator."""
    tensors = [means, log_scales, quaternions, opacities, features, position, directions]
    if axes is not None:
        tensors.append(axes)
    results = _directions_op(_as_float(*tensors), focal_length, pixel_angle, antialiased, near_plane, alpha_threshold)
    return results[0], results[1]


def _fake_harmonics(tensors: Sequence[Tensor], degree: int) -> list[Tensor]:
    constant, rest, means, position = tensors
    check_harmonics(degree, (constant, rest), means, position)
    return [torch.empty_like(means)]


_harmonics_op = register_custom_op(
    "spherical_harmonics",
    ", SymInt degree",
    lambda tensors, degree: [spherical_harmonics(degree, (tensors[0], tensors[1]), tensors[2], tensors[3])],
    _fake_harmonics,
)


def compiled_harmonics(
    degree: int, coefficients: Tensor | tuple[Tensor, Tensor], means: Tensor, camera_position: Tensor
) -> Tensor:
    """Do what spherical_harmonics() does, as a custom operator."""
    whole = isinstance(coefficients, Tensor)
    constant, rest = (coefficients[:, :1], coefficients[:, 1:]) if whole else coefficients
    return _harmonics_op(_as_float(constant, rest, means, camera_position), degree)[0]


_ssim_op = register_custom_op("ssim", "", lambda tensors: [ssim(*tensors)], lambda tensors: [tensors[0].new_empty(())])
_ssim_map_op = register_custom_op(
    "ssim_map", "", lambda tensors: [ssim_map(*tensors)], lambda tensors: [torch.empty_like(tensors[0])]
)


register_compiled(
    rasterize=compiled_rasterize,
    rasterize_directions=compiled_directions,
    spherical_harmonics=compiled_harmonics,
    ssim=lambda a, b: _ssim_op(_as_float(a, b))[0],
    ssim_map=lambda a, b: _ssim_map_op(_as_float(a, b))[0],
)
