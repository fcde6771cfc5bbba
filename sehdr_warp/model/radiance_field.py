"""The radiance field: Gaussians rendered as base exposure, fused HDR exposure and encoded values.

Every color set that a training step needs is a group of three channels of one rasterization, so that geometry is
projected, sorted and blended once.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..rasterizer import Rendering, rasterize, rasterize_directions, spherical_harmonics
from ..rasterizer.cuda_graphs.runner import without_replays
from ..response import Response
from ..scene import Camera
from ..scene.camera import require_camera
from ..scene.normalization import Normalization
from . import pixel_filter
from .color_models import make_color_model
from .fusion import NeuralExposureFusion
from .gaussians import Gaussians
from .pixel_filter import FocalRange, PhotoFilters, RayLimits
from .renders import CameraTensors, DirectionalRender, PhotoRender, RenderedView, unpremultiply

NO_DATA: Mapping[str, Tensor] = MappingProxyType({})
_PIXELS_AT_ONCE = 1 << 19  # Of which colors are decoded


class RadianceField(nn.Module):
    """A scene: Gaussians, the camera response of its photos, and, if used, the fusion of brackets.

    Attributes:
        confidence: [N] in [0, 1], confidence in each Gaussian's light; None if it was not measured.
        clipped_stops: [N], uncertainty of each Gaussian's clipped light, see Evidence; None if it was not measured.
        photo_focals: Focal lengths of the photos, with which renders of another resolution keep the light of small
            Gaussians; None in a training, and if they are not known.
        photo_filters: [N] filters of GaussianArrays, as a file states them; None of a run, whose cameras state them.
        photo_cameras: Cameras of the photos of a run, scene coordinates.
        rasterizer: rasterize(); benchmarks set a function with the same arguments.
    """

    confidence: Tensor | None
    clipped_stops: Tensor | None
    photo_filters: np.ndarray | None = None
    photo_cameras: Sequence[Camera] = ()
    rasterizer: Callable[..., Rendering] = staticmethod(rasterize)

    def __init__(
        self,
        gaussians: Gaussians,
        response: Response,
        *,
        base_time: float,
        color_model: str = "log",
        tone_map: str = "pixel",
        fusion: NeuralExposureFusion | None = None,
        antialiased: bool = False,
        deterministic: bool = False,
        normalization: Normalization | None = None,
        photo_focals: FocalRange | None = None,
    ):
        """Assemble a field.

        Args:
            gaussians: The Gaussians.
            response: Camera response from exposure to encoded values.
            base_time: Exposure time dt_1, seconds.
            color_model: Name of the color model: log, linear or display.
            tone_map: "pixel" for f(sum of weighted x); "gaussian" for the sum of weighted f(x), as the paper
                composites.
            fusion: Fusion at the same base time; without it, the HDR color is the base color.
            antialiased: Lower the opacity of Gaussians that the low-pass filter widens (Mip-Splatting).
            deterministic: Use kernels whose sums have a fixed order.
            normalization: Map between scene coordinates, of cameras and returned distances, and those of the
                Gaussians; by default the identity.
            photo_focals: As in the attributes.
        """
        super().__init__()
        self.photo_focals, self.normalization = photo_focals, normalization or Normalization()
        self.gaussians, self.fusion = gaussians, fusion
        self.response, self.base_time = response, base_time
        self.color_model, self.tone_map = make_color_model(color_model), tone_map
        self.antialiased, self.deterministic = antialiased, deterministic
        for name in ("confidence", "clipped_stops"):
            self.register_buffer(name, None, persistent=False)

    @property
    def render_device(self) -> torch.device:
        """Device that pictures are rendered on."""
        return self.gaussians.means.device

    @cached_property
    def filters(self) -> PhotoFilters | None:
        """The photos' filter at each Gaussian, as of filters_of(); the Gaussians must not move any more."""
        return pixel_filter.filters_of(self)

    @cached_property
    def ray_limits(self) -> RayLimits:
        """Rays up to which views are linearized."""
        return pixel_filter.WIDE_LIMITS if self.along_rays else RayLimits.of(self.photo_cameras)

    @cached_property
    def along_rays(self) -> bool:
        """True if pinholes, too, are drawn along their pixels' rays, see need_rays(); trainings and files set it."""
        return pixel_filter.need_rays(self.photo_cameras)

    def camera_tensors(self, camera: Camera) -> CameraTensors:
        """Return a camera of scene coordinates in those of the Gaussians, on their device."""
        require_camera(camera)
        along_rays, device = self.along_rays, self.gaussians.means.device
        return CameraTensors.of(self.normalization.camera(camera), device, along_rays=along_rays)

    def render_photo(
        self,
        camera: CameraTensors,
        exposure_time: float | Tensor,
        *,
        degree: int | None = None,
        extra_images: frozenset[str] = frozenset(),
        max_intersections: int | None = None,
        encode: bool = True,
        opacity_factors: Tensor | None = None,
        order_axis: Tensor | None = None,
        sh_gradient_hook: Callable[[Tensor], object] | None = None,
    ) -> PhotoRender:
        """Render what a photo shows, differentiably: for training steps, render_ldr(), and fits to pictures.

        Args:
            camera: The photo's camera.
            exposure_time: Seconds; a float, or a scalar tensor on the device.
            degree: Highest SH degree, by default all.
            extra_images: Further images to render: any of "exposure" and "base".
            max_intersections: As in rasterize().
            encode: If False, `encoded` stays None if `photo_exposure` is available.
            opacity_factors: [N] factors on the opacities that are rendered, at most 1, such as those of a dropout.
            order_axis: As in rasterize(); wide cameras order by distance.
            sh_gradient_hook: Receives, in the backward pass, the gradient [N, 3] by the color that each Gaussian's
                harmonics have in this direction; the harmonics themselves then get no gradient.
        """
        opacities = self.gaussians.opacities()
        visible = opacities if opacity_factors is None else (opacities * opacity_factors).clamp(max=1)
        options = {"max_intersections": max_intersections, "order_axis": order_axis, "opacities": visible}
        ratio = exposure_time / self.base_time
        values = self._evaluate_sh(camera.position, degree, detach_harmonics=sh_gradient_hook is not None)
        if sh_gradient_hook is not None:
            values.register_hook(sh_gradient_hook)  # As retain_grad(), without a copy.
        if self.color_model.display_referred:
            rendering = self._rasterize(camera, self.color_model.colors(values), **options)
            image = rendering.image
            if ratio != 1.0:
                image = self.response.encode_extended(self.response.decode(image.clamp(0, 1)) * ratio)
            return PhotoRender(image, None, None, rendering, opacities=opacities)
        color_sets = self._color_sets(values, ratio, extra_images)
        first, *others = color_sets.values()
        features = torch.cat([first, *others], dim=1) if others else first
        rendering = self._rasterize(camera, features, **options)
        # A single image is not split, because the derivative of a split is a copy.
        parts = rendering.image.split(3, dim=2) if others else (rendering.image,)
        images = dict(zip(color_sets, parts, strict=True))
        encoded, exposure, photo_exposure = images.get("encoded"), images.get("exposure"), None
        if self.tone_map == "pixel":
            photo_exposure = images["exposure"]
            if not (isinstance(ratio, float) and ratio == 1):
                photo_exposure = photo_exposure * ratio
            encoded = self.response.encode_extended(photo_exposure) if encode else None
        return PhotoRender(encoded, exposure, images.get("base", exposure), rendering, photo_exposure, opacities)

    def _color_sets(self, values: Tensor, ratio: float | Tensor, extra_images: frozenset[str]) -> dict[str, Tensor]:
        """Return the colors [N, 3] that a training view needs, by name: any of encoded, exposure and base."""
        base, exposure = self._base_and_hdr(values)  # The same tensor without fusion.
        color_sets = {"exposure": exposure}
        if self.tone_map == "gaussian":
            needs_exposure = "exposure" in extra_images or ("base" in extra_images and self.fusion is None)
            encoded = {"encoded": self.response.encode_extended(exposure * ratio)}
            color_sets = encoded | color_sets if needs_exposure else encoded
        if "base" in extra_images and self.fusion is not None:
            color_sets["base"] = base
        return color_sets

    @property
    def white(self) -> float:
        """Radiance that photos of the base exposure store as white."""
        return self.response.white / self.base_time

    @torch.no_grad()
    @without_replays()  # Views differ in size, and each graph would fit one size.
    def render(
        self, camera: Camera, *, degree: int | None = None, data: Mapping[str, Tensor] = NO_DATA
    ) -> RenderedView:
        """Render the HDR view of a camera, with depth as a fourth channel of the same rasterization.

        The depth of a camera that is not a pinhole is the distance from it. Data are further channels: values [N] by
        attributes of the result, which are what render_mean() returns.
        """
        tensors = self.camera_tensors(camera)
        pose = tensors.world_to_camera
        if camera.is_pinhole:
            depth = self.gaussians.means @ pose[2, :3, None] + pose[2, 3]
        else:
            depth = (self.gaussians.means - tensors.position).norm(dim=1, keepdim=True)
        values = [value[:, None] for value in data.values()]
        colors = self._blended_colors(tensors.position, degree)
        rendering = self._rasterize(tensors, torch.cat([colors, depth, *values], dim=1))
        alpha = rendering.alpha
        depth, *means = (unpremultiply(channel, alpha) for channel in rendering.image[..., 3:].unbind(-1))
        # In bands, because decoding takes many times the memory of what it decodes.
        image, rows = rendering.image, max(1, _PIXELS_AT_ONCE // camera.width)
        hdr = image.new_empty(*image.shape[:2], 3)
        for colors, band in zip(image[..., :3].split(rows), hdr.split(rows)):
            torch.div(self._to_exposures(colors), self.base_time, out=band)
        means = [mean.clamp_(0, 1) for mean in means]
        return RenderedView(hdr, alpha, depth.mul_(self.normalization.unit), **dict(zip(data, means, strict=True)))

    @torch.no_grad()
    def render_directions(
        self,
        position: np.ndarray,
        directions: Tensor,
        *,
        focal_length: float,
        pixel_angle: float,
        degree: int | None = None,
        beyond: float = 0.0,
        without: Sequence[Tensor] = (),
        shares: Tensor | None = None,
    ) -> DirectionalRender:
        """Render along unit directions from a position.

        Args:
            position: [3] float64, scene coordinates.
            directions: [H, W, 3] float32 unit vectors on the field's device.
            focal_length: Pixels, as in rasterize_directions().
            pixel_angle: Radians, as in rasterize_directions().
            degree: Highest SH degree, by default all.
            beyond: Gaussians whose centers are nearer than this distance are left out; scene units.
            without: indices [K] int64 of Gaussians that give no light, and hide what is behind them.
            shares: [N] in [0, 1], of each Gaussian's light, such as the clipped share.
        """
        gaussians = self.gaussians
        origin = torch.tensor(self.normalization.points(position), dtype=torch.float32, device=self.render_device)
        colors = self._blended_colors(origin, degree)
        for index in without:
            colors = colors.index_fill(0, index, 0.0)
        features = [colors, (gaussians.means - origin).norm(dim=1, keepdim=True)]
        if self.confidence is not None:
            features.append(self.confidence[:, None])
        if shares is not None:
            features.append(colors.mean(1, keepdim=True) * shares[:, None])
        place = pixel_filter.options_at_place(self, origin, gaussians.opacities(), focal_length, pixel_angle)
        options: dict[str, Any] = place._asdict() | {"antialiased": self.antialiased}
        options |= {"near_plane": beyond / self.normalization.unit} if beyond else {}
        image, transmittance = rasterize_directions(
            gaussians.means,
            quaternions=gaussians.quaternions,
            features=torch.cat(features, dim=1),
            position=origin,
            directions=directions,
            **options,
        )
        clipped = None if shares is None else image[..., -1] / image[..., :3].mean(2).clamp_min(1e-30)
        image = image if shares is None else image[..., :-1]
        alpha = 1 - transmittance
        distance, *confidence = (unpremultiply(image[..., i], alpha) for i in range(3, image.shape[2]))
        confidence = confidence[0].clamp(0, 1) if confidence else None
        distance = distance * self.normalization.unit
        hdr = self._to_exposures(image[..., :3]) / self.base_time
        return DirectionalRender(hdr, alpha, distance, confidence, clipped)

    @torch.no_grad()
    @without_replays()
    def render_ldr(self, camera: Camera, exposure_time: float | None = None, *, degree: int | None = None) -> Tensor:
        """Render the simulated photo [H, W, 3] in [0, 1] of exposure_time seconds, by default the base time."""
        time = self.base_time if exposure_time is None else exposure_time
        photo = self.render_photo(self.camera_tensors(camera), time, degree=degree).encoded
        assert photo is not None
        return photo.clamp(0, 1)

    @torch.no_grad()
    def render_confidence(self, camera: Camera) -> Tensor | None:
        """Render the mean confidence [H, W] in [0, 1], 0 if alpha is at most 0.001; None if it was not measured."""
        return None if self.confidence is None else self.render_mean(camera, self.confidence)

    @torch.no_grad()
    @without_replays()
    def render_mean(self, camera: Camera, values: Tensor) -> Tensor:
        """Render the mean [H, W] in [0, 1] of values [N] of the Gaussians, 0 if alpha is at most 0.001."""
        # Three channels like the features of a training, whose kernel is then compiled already.
        return self.render_values(camera, values[:, None].expand(-1, 3).contiguous())[..., 0].clamp(0, 1)

    def render_values(self, camera: Camera, values: Tensor) -> Tensor:
        """Render the mean [H, W, 3] of values [N, 3] of the Gaussians, 0 if alpha is at most 0.001."""
        rendering = self._rasterize(self.camera_tensors(camera), values)
        return unpremultiply(rendering.image, rendering.alpha[..., None])

    @torch.no_grad()
    def radiance_towards(self, position: np.ndarray, *, degree: int | None = None) -> Tensor:
        """Return the radiance [N, 3] of each Gaussian towards a point [3] in scene coordinates."""
        place = torch.tensor(self.normalization.points(position), dtype=torch.float32)
        return self._to_exposures(self._blended_colors(place.to(self.gaussians.means.device), degree)) / self.base_time

    @without_replays()
    def weighted_sums(
        self, camera: CameraTensors, images: Tensor, opacities: Tensor | None = None, *, at_place: bool = False
    ) -> Tensor:
        """Return [N, C]: for each Gaussian the sum over pixels of its blending weight times images [H, W, C].

        Blending is linear in the features, so this is the adjoint of a render. `opacities` [N] replace the scene's.
        `at_place`: a camera of all directions is not one of a photo but at any place, see options_at_place().
        """
        with torch.enable_grad():
            features = images.new_zeros(self.gaussians.count, images.shape[2]).requires_grad_()
            blended = self._rasterize(camera, features, opacities=opacities, at_place=at_place).image
            # The gradient of a scalar, because checking explicit gradients loads torch's compiler, two seconds.
            return torch.autograd.grad((blended * images).sum(), features)[0]

    def _evaluate_sh(self, position: Tensor, degree: int | None, *, detach_harmonics: bool = False) -> Tensor:
        """Return the sums [N, 3] of the Gaussians' harmonics towards a position [3]."""
        gaussians = self.gaussians
        sh_degree = gaussians.degree if degree is None else min(degree, gaussians.degree)
        constant, rest = gaussians.harmonics_dc, gaussians.harmonics_rest
        coefficients = (constant.detach(), rest.detach()) if detach_harmonics else (constant, rest)
        return spherical_harmonics(sh_degree, coefficients, gaussians.means, position)

    def _blended_colors(self, position: Tensor, degree: int | None) -> Tensor:
        """Return the colors [N, 3] of the HDR image towards a position [3]; see _to_exposures()."""
        values = self._evaluate_sh(position, degree)
        return self.color_model.colors(values) if self.color_model.display_referred else self._base_and_hdr(values)[1]

    def _to_exposures(self, colors: Tensor) -> Tensor:
        """Return the exposures at the base time of colors [..., 3], which may be encoded."""
        return self.response.decode(colors.clamp(0, 1)) if self.color_model.display_referred else colors

    def _base_and_hdr(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return exposures [N, 3] at the base time of each Gaussian's base color and of its HDR color."""
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
        at_place: bool = False,
        order_axis: Tensor | None = None,
    ) -> Rendering:
        """Rasterize features [N, C]; without opacities [N], gradients reach the features alone."""
        gaussians = self.gaussians
        means, log_scales, quaternions = gaussians.means, gaussians.log_scales, gaussians.quaternions
        if opacities is None:
            means, log_scales, quaternions = means.detach(), log_scales.detach(), quaternions.detach()
            opacities = gaussians.opacities().detach()
        view = pixel_filter.options_of_view(self, camera, means, log_scales, quaternions, opacities)
        shapes, opacities = (means, view.log_scales, quaternions), view.opacities
        if camera.directions is not None:
            return self._rasterize_wide(camera, camera.directions, shapes, features, opacities, at_place)
        lens = camera.world_to_camera, camera.intrinsics, camera.width, camera.height
        arguments = means, view.log_scales, quaternions, opacities, features, *lens
        return self.rasterizer(  # rasterize(), see the class
            *arguments,
            eps2d=view.eps2d,
            ray_limit_x=view.ray_limit_x,
            ray_limit_y=view.ray_limit_y,
            antialiased=self.antialiased,
            max_intersections=max_intersections,
            deterministic=self.deterministic,
            order_axis=order_axis,
        )

    def _rasterize_wide(
        self,
        camera: CameraTensors,
        directions: Tensor,
        shapes: tuple[Tensor, Tensor, Tensor],
        features: Tensor,
        opacities: Tensor,
        at_place: bool,
    ) -> Rendering:
        """Rasterize Gaussians' means, log_scales and quaternions along directions; there are no projected means."""
        means, log_scales, quaternions = shapes
        image, transmittance = rasterize_directions(
            means,
            quaternions=quaternions,
            features=features,
            position=camera.position,
            directions=directions,
            antialiased=self.antialiased,
            **pixel_filter.wide_options(self, camera, log_scales, opacities, at_place)._asdict(),
        )
        if (lens_mask := camera.lens_mask) is not None:
            image, transmittance = image * lens_mask[..., None], 1 - (1 - transmittance) * lens_mask
        none = features.new_zeros(len(features), 2)
        return Rendering(image, transmittance, none, none[:, 0], none, 0)
