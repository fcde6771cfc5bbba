"""The arguments of rasterization(): checked, and split by camera."""

import math
from itertools import product
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...rasterizer.checks import check_matrices, check_memory, check_tensors, integer
from .harmonics import HIGHEST_DEGREE, check_count, evaluate

UNSUPPORTED = {
    "sparse_grad": False,
    "distributed": False,
    "with_ut": False,
    "with_eval3d": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
    "rolling_shutter": None,
    "viewmats_rs": None,
    "return_normals": False,
    "global_z_order": True,
    "rays": None,
    "lidar_coeffs": None,
    "external_distortion_coeffs": None,
    "ut_params": None,
    "extra_signals_sh_degree": None,
    "renderer_config": None,
}
"""gsplat's arguments that have one value here; rolling_shutter may also be its GLOBAL."""


def check_supported(values: dict[str, Any]) -> None:
    """Raise ValueError, by its name, for an argument with another value than UNSUPPORTED has; TypeError for others."""
    for name, value in values.items():
        if name not in UNSUPPORTED:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        expected = UNSUPPORTED[name]
        if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
            continue
        if value is not expected and (isinstance(value, Tensor) or value != expected):
            actual = f"a tensor of shape {list(value.shape)}" if isinstance(value, Tensor) else f"{value!r:.60}"
            raise ValueError(f"{name} = {actual} is not supported, expected {expected!r}")


class View(NamedTuple):
    """The tensors of one camera of one scene, as rasterization() takes them without batch and camera axes.

    position: [3] of the camera, for harmonics; None without them.
    """

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    colors: Tensor | None
    extra_signals: Tensor | None
    viewmat: Tensor
    K: Tensor
    position: Tensor | None
    background: Tensor | None

    def features(self, sh_degree: int | None, rows: Tensor | None) -> list[Tensor]:
        """Return the colors [N, D] and the extra signals [N, E] of the Gaussians (of `rows` if given), if there are."""

        def of_rows(tensor: Tensor) -> Tensor:
            return tensor if rows is None else tensor[rows]

        features = [of_rows(tensor) for tensor in (self.colors, self.extra_signals) if tensor is not None]
        if self.position is not None and sh_degree is not None:
            values = evaluate(sh_degree, features[0], of_rows(self.means), self.position)
            # Clamped, -inf would be a color.
            features[0] = torch.where(values.isneginf(), values, (values + 0.5).clamp_min(0.0))
        return features


def split_views(
    means: Any,
    quats: Any,
    scales: Any,
    covars: Any,
    opacities: Any,
    colors: Any,
    extra_signals: Any,
    viewmats: Any,
    Ks: Any,
    backgrounds: Any,
    sh_degree: int | None,
) -> list[View]:
    """Check shapes, types and devices of rasterization()'s tensors; return those of each camera, scene by scene.

    All have the batch axes of means. covars take the place of quats and scales. Colors, extra_signals and backgrounds
    may be None.
    """
    batch = tuple(means.shape[:-2]) if isinstance(means, Tensor) else ()
    color_axes: tuple[int | str, ...] = ("N", "D")
    if sh_degree is not None:
        sh_degree = integer("sh_degree", sh_degree, 0, HIGHEST_DEGREE)
        color_axes = ("N", "K", 3)
        if isinstance(colors, Tensor) and colors.ndim == 3:  # gsplat 1.6 shares coefficients among scenes.
            colors = colors.expand(batch + colors.shape)
    feature_axes = {"colors": (colors, color_axes), "extra_signals": (extra_signals, ("N", "E"))}
    features = {name: each for name, each in feature_axes.items() if each[0] is not None}
    by_camera = {
        name
        for name, (tensor, axes) in features.items()
        if isinstance(tensor, Tensor) and tensor.ndim == len(batch) + len(axes) + 1
    }

    shapes: dict[str, Any] = {"means": (means, (*batch, "N", 3))}
    if covars is None:
        shapes |= {"quats": (quats, (*batch, "N", 4)), "scales": (scales, (*batch, "N", 3))}
    else:
        quats = scales = None
        shapes["covars"] = (covars, (*batch, "N", 3, 3))
    shapes |= {
        "opacities": (opacities, (*batch, "N")),
        "viewmats": (viewmats, (*batch, "C", 4, 4)),
        "Ks": (Ks, (*batch, "C", 3, 3)),
    }
    for name, (tensor, axes) in features.items():
        shapes[name] = (tensor, (*batch, *(("C",) if name in by_camera else ()), *axes))
    if backgrounds is not None:
        channels = sum(
            tensor.shape[-1] for tensor, _ in features.values() if isinstance(tensor, Tensor) and tensor.ndim
        )
        is_shared = isinstance(backgrounds, Tensor) and backgrounds.ndim == 1  # All that gsplat 1.5 takes if packed.
        shapes["backgrounds"] = (backgrounds, (channels,) if is_shared else (*batch, "C", channels))
    check_tensors(**shapes)
    check_memory(means=means, viewmats=viewmats, Ks=Ks)
    check_matrices(viewmats=viewmats, Ks=Ks)
    if covars is not None:  # gsplat reads the upper triangle alone, so only that gets a gradient.
        covars = covars.flatten(-2)[..., (0, 1, 2, 1, 4, 5, 2, 5, 8)].unflatten(-1, (3, 3))
    if colors is not None and sh_degree is not None:
        check_count("colors", colors, "sh_degree", sh_degree)
    if not math.prod(viewmats.shape[:-2]):
        raise ValueError(f"viewmats has shape {list(viewmats.shape)}, which has no camera")
    for name, (tensor, _) in features.items():
        if not tensor.shape[-1]:
            raise ValueError(f"{name} has shape {list(tensor.shape)}, which has no channel")

    # The inverse of a singular matrix is not finite: its camera shows nothing.
    positions = None if sh_degree is None else torch.linalg.inv_ex(viewmats)[0][..., :3, 3]

    def own(tensor: Tensor | None, index: tuple[int, ...]) -> Tensor | None:
        return None if tensor is None else tensor[index]

    return [
        View(
            means[camera[:-1]],
            own(quats, camera[:-1]),
            own(scales, camera[:-1]),
            own(covars, camera[:-1]),
            opacities[camera[:-1]],
            own(colors, camera if "colors" in by_camera else camera[:-1]),
            own(extra_signals, camera if "extra_signals" in by_camera else camera[:-1]),
            viewmats[camera],
            Ks[camera],
            own(positions, camera),
            own(backgrounds, camera if backgrounds is None or backgrounds.ndim > 1 else ()),
        )
        for camera in product(*map(range, viewmats.shape[:-2]))
    ]
