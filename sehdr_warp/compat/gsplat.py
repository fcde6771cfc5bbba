"""gsplat's rasterization() (Ye et al. 2025, version 1.5), made of rasterize(): a trainer that imports it from here runs
on the CPU, too."""

from typing import Any, Literal

import torch
from torch import Tensor

from ..rasterizer import rasterize, spherical_harmonics

ONE_VALUE = {
    **dict.fromkeys(("sparse_grad", "absgrad", "distributed", "segmented", "with_ut", "with_eval3d"), False),
    **dict.fromkeys(("covars", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs"), None),
    "viewmats_rs": None,
    "camera_model": "pinhole",
    "radius_clip": 0.0,
}
"""gsplat's arguments that have one value here."""
RENDER_MODES = "RGB", "D", "ED", "RGB+D", "RGB+ED"


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """N Gaussians seen by C cameras, with gsplat's arguments and results.

    Args:
        means: [N, 3].
        quats: [N, 4] (w, x, y, z).
        scales: [N, 3], positive.
        opacities: [N].
        colors: [N, D] or [C, N, D], or with sh_degree coefficients [N, K, 3].
        viewmats: [C, 4, 4] world to camera.
        Ks: [C, 3, 3].
        width: of the images, pixels.
        height: likewise.
        near_plane: what is nearer is left out, scene units.
        far_plane: what is farther.
        eps2d: variance in square pixels added to each splat.
        sh_degree: of the harmonics; None for plain colors.
        packed: is taken for gsplat's sake: the third result is as without it.
        tile_size: has no effect.
        backgrounds: [C, D].
        render_mode: "RGB", "D", "ED", "RGB+D" or "RGB+ED".
        rasterize_mode: "classic" or "antialiased".
        channel_chunk: has no effect.
        others: gsplat's further arguments, with the one value that is supported here (ONE_VALUE: no absgrad, sparse
            gradients, distortion, other camera models).

    Returns:
        Colors [C, H, W, D], with depths as one more channel ("RGB+D": blended, "RGB+ED": expected) or as the only one
        ("D", "ED"); alphas [C, H, W, 1]; and what densification reads: means2d [C, N, 2], which can retain its
        gradient, radii [C, N, 2] int32 (0 where culled), depths [C, N], width, height, n_cameras and the like.

    Raises:
        ValueError: for another render_mode, or another value of a further argument.
        TypeError: for unknown ones.
    """
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode {render_mode!r} is none of {', '.join(RENDER_MODES)}")
    others.pop("rolling_shutter", None)  # has no effect without viewmats_rs
    for name, value in others.items():
        if name not in ONE_VALUE:
            raise TypeError(f"rasterization() has no argument {name!r}")
        if value is not ONE_VALUE[name] and value != ONE_VALUE[name]:
            raise ValueError(f"{name} = {value!r:.60} is not supported, expected {ONE_VALUE[name]!r}")
    views = torch.linalg.inv(viewmats)[:, :3, 3]
    if sh_degree is not None:
        colors = torch.stack([spherical_harmonics(sh_degree, colors, means, view) for view in views])
        colors = (colors + 0.5).clamp_min(0.0)
    if far_plane < 1e10:
        depths = torch.einsum("cj,nj->cn", viewmats[:, 2, :3], means) + viewmats[:, 2, 3:]
        opacities = torch.where(depths <= far_plane, opacities, 0.0)
    lenses = torch.stack([Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]], dim=1)
    rendering = rasterize(
        means, scales.log(), quats, opacities, colors, viewmats, lenses, width, height, near_plane=near_plane,
        eps2d=eps2d, antialiased=rasterize_mode == "antialiased", depth="D" in render_mode, background=backgrounds,
    )  # fmt: skip
    alphas = rendering.alpha[..., None]
    shown = [rendering.image] if "RGB" in render_mode else []
    if rendering.depth is not None:
        depth = rendering.depth[..., None]
        shown.append(depth / alphas.clamp_min(1e-10) if "E" in render_mode else depth)
    radii = rendering.extents.ceil().int()
    ids = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    sizes = {"width": width, "height": height, "tile_size": tile_size, "n_batches": 1, "n_cameras": len(viewmats)}
    seen = {"means2d": rendering.means2d, "radii": radii, "depths": rendering.depths, "opacities": opacities}
    return torch.cat(shown, dim=-1), alphas, ids | seen | sizes
