"""The arguments of rasterization(): checked, and taken apart by camera."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...rasterizer import spherical_harmonics
from ...rasterizer.checks import check_tensors, integer
from .harmonics import check_degree

UNSUPPORTED = {
    "sparse_grad": False,
    "distributed": False,
    "with_ut": False,
    "with_eval3d": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
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
"""gsplat's arguments that have one value here."""


def check_supported(values: dict[str, Any], rolling_shutter: Any) -> None:
    """Raise ValueError, by its name, for an argument with another value than UNSUPPORTED has."""
    for name, value in values.items():
        if value is not UNSUPPORTED[name] and (isinstance(value, Tensor) or value != UNSUPPORTED[name]):
            actual = f"a tensor of shape {list(value.shape)}" if isinstance(value, Tensor) else f"{value!r:.60}"
            raise ValueError(f"{name} = {actual} is not supported, expected {UNSUPPORTED[name]!r}")
    if rolling_shutter is not None and getattr(rolling_shutter, "name", None) != "GLOBAL":
        raise ValueError(f"rolling_shutter = {rolling_shutter!r:.60} is not supported, expected a global shutter")


class View(NamedTuple):
    """The inputs of one camera of one batch."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    colors: Tensor | None
    extra_signals: Tensor | None
    viewmat: Tensor
    K: Tensor
    position: Tensor
    background: Tensor | None

    def features(self, sh_degree: int | None, rows: Tensor | None) -> list[Tensor]:
        """Return the colors [N, D] and the extra signals [N, E] of the Gaussians (of `rows` if given), if there are."""

        def of_rows(tensor: Tensor) -> Tensor:
            return tensor if rows is None else tensor[rows]

        features = [of_rows(tensor) for tensor in (self.colors, self.extra_signals) if tensor is not None]
        if sh_degree is not None and self.colors is not None:
            values = spherical_harmonics(sh_degree, features[0], of_rows(self.means), self.position)
            features[0] = (values + 0.5).clamp_min(0.0)
        return features


class Inputs(NamedTuple):
    """The arguments with one batch axis of B."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    colors: Tensor | None
    extra_signals: Tensor | None
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor | None
    by_camera: tuple[bool, bool]

    @staticmethod
    def flattened(
        means: Any,
        quats: Any,
        scales: Any,
        opacities: Any,
        colors: Any,
        extra_signals: Any,
        viewmats: Any,
        Ks: Any,
        backgrounds: Any,
        covars: Any,
        sh_degree: int | None,
    ) -> "Inputs":
        """Check the arguments' shapes, types and devices, and flatten their batch axes to one.

        colors and extra_signals may be None.
        """
        batch = tuple(means.shape[:-2]) if isinstance(means, Tensor) else ()
        inner: tuple[int | str, ...] = ("N", "D")
        if sh_degree is not None:
            check_degree("sh_degree", integer("sh_degree", sh_degree, 0, 4))
            inner = ("N", "K", 3)
            if isinstance(colors, Tensor) and colors.ndim == 3:  # gsplat 1.6 shares coefficients among scenes.
                colors = colors.expand(batch + colors.shape)

        def by_camera(features: Any, inner: tuple) -> bool:
            return isinstance(features, Tensor) and features.ndim == len(batch) + len(inner) + 1

        def feature_shape(features: Any, inner: tuple) -> tuple:
            return *batch, *(("C",) if by_camera(features, inner) else ()), *inner

        shapes: dict[str, Any] = {"means": (means, (*batch, "N", 3))}
        if covars is None:
            shapes |= {"quats": (quats, (*batch, "N", 4)), "scales": (scales, (*batch, "N", 3))}
        else:
            shapes["covars"] = (covars, (*batch, "N", 3, 3))
        shapes |= {
            "opacities": (opacities, (*batch, "N")),
            "viewmats": (viewmats, (*batch, "C", 4, 4)),
            "Ks": (Ks, (*batch, "C", 3, 3)),
        }
        if colors is not None:
            shapes["colors"] = (colors, feature_shape(colors, inner))
        if extra_signals is not None:
            shapes["extra_signals"] = (extra_signals, feature_shape(extra_signals, ("N", "E")))
        if backgrounds is not None:
            features = [tensor for tensor in (colors, extra_signals) if isinstance(tensor, Tensor) and tensor.ndim]
            shapes["backgrounds"] = (backgrounds, (*batch, "C", sum(tensor.shape[-1] for tensor in features)))
        check_tensors(**shapes)
        if colors is not None and sh_degree is not None and colors.shape[-2] < (sh_degree + 1) ** 2:
            raise ValueError(
                f"colors has shape {list(colors.shape)}, but sh_degree {sh_degree} needs {(sh_degree + 1) ** 2} "
                "coefficients"
            )
        if not math.prod(viewmats.shape[:-2]):
            raise ValueError(f"viewmats has shape {list(viewmats.shape)}, which has no camera")
        for name, features in (("colors", colors), ("extra_signals", extra_signals)):
            if features is not None and not features.shape[-1]:
                raise ValueError(f"{name} has shape {list(features.shape)}, which has no channel")

        def flat(tensor: Tensor | None) -> Tensor | None:
            if tensor is None or len(batch) == 1:
                return tensor
            return tensor.reshape(math.prod(batch), *tensor.shape[len(batch) :])

        values = means, quats, scales, covars, opacities, colors, extra_signals, viewmats, Ks, backgrounds
        both = by_camera(colors, inner), by_camera(extra_signals, ("N", "E"))
        return Inputs(*map(flat, values), both)  # pyright: ignore[reportCallIssue]

    def views(self) -> Iterator[View]:
        """Yield the inputs of each camera, batch by batch."""

        def own(features: Tensor | None, batch: int, camera: int, by_camera: bool) -> Tensor | None:
            if features is None:
                return None
            return features[batch, camera] if by_camera else features[batch]

        inverse, _ = torch.linalg.inv_ex(self.viewmats)  # Of a singular matrix not finite: it then shows nothing.
        for batch in range(len(self.means)):
            for camera in range(self.viewmats.shape[1]):
                yield View(
                    self.means[batch],
                    None if self.quats is None else self.quats[batch],
                    None if self.scales is None else self.scales[batch],
                    None if self.covars is None else self.covars[batch],
                    self.opacities[batch],
                    own(self.colors, batch, camera, self.by_camera[0]),
                    own(self.extra_signals, batch, camera, self.by_camera[1]),
                    self.viewmats[batch, camera],
                    self.Ks[batch, camera],
                    inverse[batch, camera, :3, 3],
                    None if self.backgrounds is None else self.backgrounds[batch, camera],
                )
