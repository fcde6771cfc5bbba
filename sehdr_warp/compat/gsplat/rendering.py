"""gsplat's rasterization() made of the rasterizer's stages."""

from functools import partial
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from ...rasterizer.checks import integer
from ...rasterizer.memory import oom_context
from ...rasterizer.rasterization import render_projected, replay_projected
from ...rasterizer.render_options import MAX_SIDE, RenderOptions
from ...rasterizer.torch_contract import torch_operation
from .inputs import check_supported, split_views
from .projection import CameraModel, ProjectionOptions, project_gaussians
from .splats import JoinedSplats, make_meta

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RENDER_MODES = get_args(RenderMode)
RASTERIZE_MODES = "classic", "antialiased"
DEFAULT_TILE_SIZE = 16


@torch_operation
def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: CameraModel = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    *,
    extra_signals: Tensor | None = None,
    **unsupported: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Rasterize N Gaussians to the images of C cameras, with gsplat's arguments and results.

    Args:
        means: [..., N, 3]; "..." are batch axes, which all tensors share.
        quats: [..., N, 4] (w, x, y, z); None with covars.
        scales: [..., N, 3]; None with covars.
        opacities: [..., N]; above 1 they saturate as in gsplat.
        colors: [..., N, D] or [..., C, N, D]; with sh_degree coefficients [..., N, K, 3] or [..., C, N, K, 3]. None or
            D = 0 if only depths are rendered.
        viewmats: [..., C, 4, 4] world to camera.
        Ks: [..., C, 3, 3].
        width: of the images, pixels.
        height: of the images, pixels.
        near_plane: least depth, scene units.
        far_plane: largest depth, scene units.
        radius_clip: Gaussians whose radii in pixels are not larger are left out.
        eps2d: variance in square pixels added to each 2D Gaussian.
        sh_degree: 0 to 4, of the harmonics; None for plain colors.
        packed: return the visible Gaussians alone in the third result.
        tile_size: of the third result's intersections, 16 by default; rendering has its own.
        backgrounds: [..., C, D], or [D] of all cameras; with extra_signals D + E channels.
        render_mode: "RGB", "D", "ED", "RGB+D" or "RGB+ED".
        sparse_grad: must be False.
        absgrad: the backward pass writes meta["means2d"].absgrad, the sums over pixels of absolute gradients.
        rasterize_mode: "classic" or "antialiased".
        channel_chunk: has no effect.
        distributed: must be False.
        camera_model: "pinhole", "ortho" or "fisheye".
        segmented: has no effect.
        covars: [..., N, 3, 3] in place of quats and scales.
        extra_signals: [..., N, E] or [..., C, N, E], blended to the third result's "render_extra_signals"
            [..., C, H, W, E].
        **unsupported: gsplat's other arguments, which must have their default values; see docs/gsplat.md.

    Returns:
        Colors [..., C, H, W, D], with depths as one more channel ("RGB+D": blended, "RGB+ED": expected) or as the only
        one ("D", "ED"); alphas [..., C, H, W, 1]; and a dictionary with gsplat's keys, of which those about
        intersections are computed when they are first read.

    Raises:
        TypeError: for what is not a tensor or not a number, and for colors that are missing.
        ValueError: for an argument that is not supported, by its name, and for shapes, dtypes or devices that do not
            fit.
    """
    check_supported({"sparse_grad": sparse_grad, "distributed": distributed, **unsupported})
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode {render_mode!r} is none of {', '.join(RENDER_MODES)}")
    if rasterize_mode not in RASTERIZE_MODES:
        raise ValueError(f"rasterize_mode {rasterize_mode!r} is none of {', '.join(RASTERIZE_MODES)}")
    antialiased, has_depth, has_color = rasterize_mode == "antialiased", "D" in render_mode, "RGB" in render_mode
    options = ProjectionOptions(
        *(width, height, near_plane, far_plane, radius_clip, eps2d, antialiased, camera_model)
    ).checked()
    tile_size = integer("tile_size", DEFAULT_TILE_SIZE if tile_size is None else tile_size, 1, MAX_SIDE)
    if colors is None and has_color:
        raise TypeError(f"colors is None, and render_mode {render_mode!r} renders them")
    is_empty = isinstance(colors, Tensor) and colors.shape[-1:] == (0,)
    if not has_color or (has_depth and is_empty and extra_signals is None):
        colors = sh_degree = backgrounds = None
    views = split_views(
        means, quats, scales, covars, opacities, colors, extra_signals, viewmats, Ks, backgrounds, sh_degree
    )
    size, shape = (options.width, options.height), viewmats.shape[:-2]
    with oom_context(means.device, lambda: (means.shape[-2], *size)):
        splats = JoinedSplats.of([project_gaussians(view, options) for view in views], packed, shape)
        means2d = splats.all.means2d
        absolute = None
        if absgrad and means2d.requires_grad:
            means2d.absgrad = torch.zeros_like(means2d)  # pyright: ignore[reportAttributeAccessIssue]
            absolute = splats.by_view(means2d.absgrad)  # pyright: ignore[reportAttributeAccessIssue]
        images, alphas, extras = [], [], []
        for index, view in enumerate(views):
            rows = splats.rows[index]
            projected = splats.of_view(index)
            features = view.features(sh_degree, None if splats.gaussian_ids is None else splats.gaussian_ids[rows])
            if has_depth:
                features.append(projected.depths[:, None])
            features = torch.cat(features, 1) if len(features) > 1 else features[0]
            store = None if absolute is None else partial(absolute.__setitem__, rows)
            inputs = projected, features, RenderOptions(*size)  # The projection has read the others.
            # The number of packed Gaussians differs from view to view, so no CUDA graph fits two of them.
            replayed = None if packed or store else replay_projected(*inputs)
            rendering = render_projected(*inputs, store) if replayed is None else replayed
            image, transmittance = rendering.image, rendering.transmittance
            if view.background is not None:
                behind = view.background
                behind = torch.cat([behind, behind.new_zeros(1)]) if has_depth else behind
                image = image + transmittance[..., None] * behind
            alpha = 1.0 - transmittance[..., None]
            if "E" in render_mode:
                expected = image[..., -1:] / alpha.clamp_min(1e-10)
                image = torch.cat([image[..., :-1], expected], -1)
            if extra_signals is not None:
                channels = image.shape[-1] - has_depth - extra_signals.shape[-1], extra_signals.shape[-1], has_depth
                color, extra, depth = image.split_with_sizes(channels, -1)
                image = torch.cat([color, depth], -1)
                extras.append(extra)
            images.append(image)
            alphas.append(alpha)
    meta = make_meta(splats, shape, size, tile_size)
    if extras:
        meta["render_extra_signals"] = torch.stack(extras).unflatten(0, shape)
    return torch.stack(images).unflatten(0, shape), torch.stack(alphas).unflatten(0, shape), meta
