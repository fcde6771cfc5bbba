"""Gaussians that know light: the colors of a view, from base exposure over brackets and fusion to encoded values.

Every color set that a step needs is a group of three channels of one rasterisation, so that geometry is projected,
sorted and blended once.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from ..rasterizer import Rendering, rasterize, rasterize_directions, spherical_harmonics
from ..rasterizer.activations import opacities_with_penalty
from ..response import Response
from ..scene import Camera
from ..scene.normalization import Normalization
from .color_models import color_model
from .fusion import NeuralExposureFusion
from .gaussians import Gaussians


@dataclass(frozen=True)
class CameraTensors:
    """A camera on a device. world_to_camera [4, 4], intrinsics [4] (fx, fy, cx, cy), position [3]; all float32."""

    width: int
    height: int
    world_to_camera: Tensor
    intrinsics: Tensor
    position: Tensor

    @staticmethod
    def of(camera: Camera, device: torch.device | str) -> "CameraTensors":
        values = camera.world_to_camera, camera.intrinsics, camera.position
        tensors = (torch.tensor(value, dtype=torch.float32, device=device) for value in values)
        return CameraTensors(camera.width, camera.height, *tensors)


@dataclass(frozen=True)
class Photograph:
    """A differentiable simulated photo; images [H, W, 3], None where they were not asked for.

    encoded: encoded values, extended beyond [0, 1] as by Response.encode_extended.
    exposure: of the HDR color at the base time (I^h dt_1 of the paper); None where colors are encoded.
    base: of the base color at the base time (I^b); the same tensor as `exposure` without fusion.
    rendering: what the rasterizer knows: alpha, projected means, radii.
    light: exposure of this photo, which the response encoded; None where colors are encoded before they are composited.
    by_harmonics: where they are factored, has after a backward pass the gradient [N, 3] by what each Gaussian's
        harmonics are in this direction.
    opacity_cost: opacity_weight times the mean opacity, a scalar; None without a weight.
    """

    encoded: Tensor | None
    exposure: Tensor | None
    base: Tensor | None
    rendering: Rendering
    light: Tensor | None = None
    by_harmonics: tuple[Tensor, ...] | list[Tensor] = ()
    opacity_cost: Tensor | None = None


@dataclass(frozen=True)
class RenderedView:
    """What a trained scene looks like from a camera, composited over black.

    hdr: [H, W, 3] float32 scene-linear radiance, >= 0, not multiplied by an exposure time.
    alpha: [H, W] coverage in [0, 1].
    depth: [H, W] mean distance along the camera's axis where alpha is above 0.001, else 0; world units.
    """

    hdr: Tensor
    alpha: Tensor
    depth: Tensor


@dataclass(frozen=True)
class Surroundings:
    """What a trained scene looks like along given directions from one point, composited over black; [H, W] each.

    hdr [H, W, 3], alpha: as of RenderedView. distance: mean distance where alpha is above 0.001, else 0; world units.
    confidence: in [0, 1], as of render_confidence; None where it was not measured.
    """

    hdr: Tensor
    alpha: Tensor
    distance: Tensor
    confidence: Tensor | None


class RadianceField(nn.Module):
    """A scene: Gaussians, the camera response that photographed them, and, where used, the fusion of brackets.

    base_time: dt_1, seconds. rasterizer: rasterize(), or what takes its arguments in its place.
    radiance: the name of the color model. tone_map: "pixel": f(sum of weighted x); "gaussian": sum of weighted f(x), as
    the paper composites. fusion: at the same base time; without, the HDR color is the base color.
    normalization: between the coordinates of the scene, in which cameras come and distances are returned, and those of
    the Gaussians.
    confidence: [N] in [0, 1], how far the photos vouch for each Gaussian; None where it was not measured.
    """

    confidence: Tensor | None

    def __init__(
        self,
        gaussians: Gaussians,
        response: Response,
        *,
        base_time: float,
        rasterizer: Callable[..., Rendering] = rasterize,
        radiance: str = "log",
        tone_map: str = "pixel",
        fusion: NeuralExposureFusion | None = None,
        antialiased: bool = False,
        deterministic: bool = False,
        normalization: Normalization | None = None,
    ):
        super().__init__()
        self.normalization = normalization or Normalization()
        self.gaussians, self.fusion, self.rasterizer = gaussians, fusion, rasterizer
        self.response, self.base_time = response, base_time
        self.color_model, self.tone_map = color_model(radiance), tone_map
        self.antialiased, self.deterministic = antialiased, deterministic
        self.register_buffer("confidence", None, persistent=False)

    def camera_tensors(self, camera: Camera) -> CameraTensors:
        """Return a camera of scene coordinates in those of the Gaussians, on their device."""
        return CameraTensors.of(self.normalization.camera(camera), self.gaussians.means.device)

    def photograph(
        self,
        camera: CameraTensors,
        exposure_time: float | Tensor,
        *,
        degree: int | None = None,
        also: frozenset[str] = frozenset(),
        max_intersections: int | None = None,
        encode: bool = True,
        factored: bool = False,
        opacity_weight: float = 0.0,
    ) -> Photograph:
        """A photo of exposure_time seconds, harmonics up to `degree`; also: which of "exposure" and "base" are wanted;
        max_intersections: as rasterize() takes it; encode: False leaves a photo that has an exposure at that; factored:
        the harmonics' coefficients get no gradient, and that by their values is in by_harmonics; opacity_weight: what
        the opacities, which are made for the photo, cost at that."""
        gaussians, opacities, cost = self.gaussians, None, None
        if opacity_weight:
            opacities, cost = opacities_with_penalty(gaussians.opacity_logits, opacity_weight, gaussians.live)
        ratio = exposure_time / self.base_time
        values = self._values(camera.position, degree, factored)
        kept: list[Tensor] = []
        if factored:
            values.register_hook(kept.append)  # As retain_grad(), without a copy.
        if self.color_model.encoded:
            rendering = self._rasterize(camera, self.color_model.colors(values), max_intersections, opacities)
            image = rendering.image
            if ratio != 1.0:
                image = self.response.encode_extended(self.response.decode(image.clamp(0, 1)) * ratio)
            return Photograph(image, None, None, rendering, None, kept, cost)
        base, fused = self._exposures(values)
        sets = {"fused": fused}
        if self.tone_map == "gaussian":
            wanted = "exposure" in also or ("base" in also and self.fusion is None)
            sets = {"encoded": self.response.encode_extended(fused * ratio)} | (sets if wanted else {})
        if "base" in also and self.fusion is not None:
            sets["base"] = base
        features = torch.cat(list(sets.values()), dim=1) if len(sets) > 1 else next(iter(sets.values()))
        rendering = self._rasterize(camera, features, max_intersections, opacities)
        # Not split where it is one: the split's derivative would be a copy.
        parts = rendering.image.split(3, dim=2) if len(sets) > 1 else (rendering.image,)
        images = dict(zip(sets, parts, strict=True))
        encoded, exposure, light = images.get("encoded"), images.get("fused"), None
        if self.tone_map == "pixel":
            # Most photos of a set have its base time.
            light = exposure if isinstance(ratio, float) and ratio == 1 else images["fused"] * ratio
            encoded = self.response.encode_extended(light) if encode else None
        return Photograph(encoded, exposure, images.get("base", exposure), rendering, light, kept, cost)

    @torch.no_grad()
    def render(self, camera: Camera, *, degree: int | None = None) -> RenderedView:
        """The HDR view of a camera, by one rasterisation of radiance and depth."""
        tensors = self.camera_tensors(camera)
        pose = tensors.world_to_camera
        depth = self.gaussians.means @ pose[2, :3, None] + pose[2, 3]
        encoded, values = self.color_model.encoded, self._values(tensors.position, degree)
        colors = self.color_model.colors(values) if encoded else self._exposures(values)[1]
        rendering = self._rasterize(tensors, torch.cat([colors, depth], dim=1))
        colors, depth = rendering.image[..., :3], rendering.image[..., 3]
        if encoded:
            colors = self.response.decode(colors.clamp(0, 1))
        depth = _mean_of_seen(depth, rendering.alpha) * self.normalization.unit
        return RenderedView(colors / self.base_time, rendering.alpha, depth)

    @torch.no_grad()
    def render_directions(
        self,
        position: np.ndarray,
        directions: Tensor,
        *,
        focal_length: float,
        pixel_angle: float,
        degree: int | None = None,
    ) -> Surroundings:
        """Render what is seen along directions from a point.

        Args:
            position: [3] float64, scene coordinates.
            directions: [H, W, 3] float32 unit vectors on the field's device.
            focal_length: pixels, as rasterize_directions() takes it.
            pixel_angle: radians, likewise.
            degree: of the harmonics; by default all.
        """
        gaussians, seen_from = self.gaussians, self.normalization.points(position)
        origin = torch.tensor(seen_from, dtype=torch.float32, device=gaussians.means.device)
        encoded, values = self.color_model.encoded, self._values(origin, degree)
        colors = self.color_model.colors(values) if encoded else self._exposures(values)[1]
        features = [colors, (gaussians.means - origin).norm(dim=1, keepdim=True)]
        if self.confidence is not None:
            features.append(self.confidence[:, None])
        image, transmittance = rasterize_directions(
            *(gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacities()),
            *(torch.cat(features, dim=1), origin, directions),
            focal_length=focal_length,
            pixel_angle=pixel_angle,
            antialiased=self.antialiased,
        )
        alpha, colors = 1 - transmittance, image[..., :3]
        colors = self.response.decode(colors.clamp(0, 1)) if encoded else colors
        distance, *confidence = (_mean_of_seen(image[..., i], alpha) for i in range(3, image.shape[2]))
        confidence = confidence[0].clamp(0, 1) if confidence else None
        return Surroundings(colors / self.base_time, alpha, distance * self.normalization.unit, confidence)

    @torch.no_grad()
    def render_ldr(self, camera: Camera, exposure_time: float | None = None, *, degree: int | None = None) -> Tensor:
        """[H, W, 3] in [0, 1]: the simulated photo of exposure_time seconds, by default the base time."""
        tensors = self.camera_tensors(camera)
        photo = self.photograph(tensors, exposure_time or self.base_time, degree=degree).encoded
        assert photo is not None
        return photo.clamp(0, 1)

    @torch.no_grad()
    def render_confidence(self, camera: Camera) -> Tensor | None:
        """[H, W] in [0, 1]: the mean confidence of what a camera sees, 0 where alpha is not above 0.001; None where it
        was not measured."""
        return None if self.confidence is None else self.render_mean(camera, self.confidence)

    @torch.no_grad()
    def render_mean(self, camera: Camera, values: Tensor) -> Tensor:
        """[H, W] in [0, 1]: the mean of the Gaussians' values [N] over what a camera sees, 0 where alpha is not above
        0.001."""
        # As wide as a training's features, though one channel is meant: no further kernel is compiled.
        features = values[:, None].expand(-1, 3).contiguous()
        rendering = self._rasterize(self.camera_tensors(camera), features)
        return _mean_of_seen(rendering.image[..., 0], rendering.alpha).clamp(0, 1)

    def weighted_sums(self, camera: CameraTensors, images: Tensor) -> Tensor:
        """[N, C]: for each Gaussian the sum over a view's pixels of its blending weight times images [H, W, C].
        Blending is linear in the features, so this is the adjoint of a render."""
        with torch.enable_grad():
            features = images.new_zeros(self.gaussians.count, images.shape[2]).requires_grad_()
            blended = self._rasterize(camera, features).image
            # Of one number: to check given gradients torch loads its compiler, two seconds.
            return torch.autograd.grad((blended * images).sum(), features)[0]

    def _values(self, position: Tensor, degree: int | None, factored: bool = False) -> Tensor:
        """[N, 3], what the Gaussians' harmonics are towards a position [3]."""
        gaussians = self.gaussians
        used = gaussians.degree if degree is None else min(degree, gaussians.degree)
        constant, rest = gaussians.harmonics_dc, gaussians.harmonics_rest
        coefficients = (constant.detach(), rest.detach()) if factored else (constant, rest)
        return spherical_harmonics(used, coefficients, gaussians.means, position)

    def _exposures(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Exposures at the base time of each Gaussian's base color and of its HDR color, [N, 3] each."""
        base = self.color_model.colors(values)
        if self.fusion is None:
            return base, base
        return base, self.fusion(self.color_model.logarithms(values, base)) * self.base_time

    def _rasterize(
        self,
        camera: CameraTensors,
        features: Tensor,
        max_intersections: int | None = None,
        opacities: Tensor | None = None,
    ) -> Rendering:
        """opacities: [N], where they are made already."""
        gaussians = self.gaussians
        opacities = gaussians.opacities() if opacities is None else opacities
        return self.rasterizer(
            *(gaussians.means, gaussians.log_scales, gaussians.quaternions, opacities, features),
            *(camera.world_to_camera, camera.intrinsics, camera.width, camera.height),
            antialiased=self.antialiased,
            max_intersections=max_intersections,
            deterministic=self.deterministic,
        )


def _mean_of_seen(blended: Tensor, alpha: Tensor) -> Tensor:
    """The mean of what was blended where alpha is above 0.001, else 0; [H, W] each."""
    return torch.where(alpha > 1e-3, blended / alpha.clamp_min(1e-3), torch.zeros_like(blended))
