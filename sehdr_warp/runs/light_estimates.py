"""Estimates of the light of clipped pixels: the loss pulls light towards them, and they say how sure it is.

The learned prior sees panoramas and wide fisheye photos through perspective faces.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..prior import ClippedLight, coarse_size, combined_estimates, load_prior
from ..prior.estimate import LARGEST, LightEstimate, LightPrior
from ..response import Response
from ..scene import Camera, View
from ..scene.wide_camera import (
    FACE_ANGLE,
    face_rotations,
    face_size,
    pixel_directions,
    pixels_of_directions,
    solid_angles,
)
from .config import LossConfig

_SHARPNESS = 4  # Power of the cosine to a face's axis by which it counts: near its border a face sees no surroundings


@torch.no_grad()
def light_estimates(
    views: Sequence[View], response: Response | None, config: LossConfig, device: torch.device
) -> list[ClippedLight] | None:
    """Return what is known of each view's clipped light, on the CPU.

    None where nothing clips, where the loss does not use it, or where nothing is known. The views are seen by the
    learned prior if config.light_prior is on; light that a photo's file states counts in any case.

    The prior runs on `device`. `response` is the curve by which exposures are compared, None if they are not. In a
    training, estimates of panoramas and wide fisheye photos weigh by the solid angles of their pixels, relative to the
    mean, as the rest of the loss does.

    Raises:
        InputError: if the weights of the prior cannot be read.
    """
    if response is None or not config.clipping or config.clipped_estimate == 0:
        return None
    masks = [torch.from_numpy(view.codes >= view.levels) for view in views]
    has_estimate = [config.light_prior or view.light_above_white is not None for view in views]
    if not any(some and bool(mask.any()) for some, mask in zip(has_estimate, masks, strict=True)):
        return None
    prior = load_prior(device) if config.light_prior else None
    result, face_prior = [], None
    for view, mask in zip(views, masks, strict=True):
        view_prior = prior
        if prior is not None and not view.camera.is_pinhole:
            if face_prior is None or not face_prior.fits(view.camera):
                face_prior = FacePrior(prior, view.camera)
            view_prior = face_prior
        if not bool(mask.any()):
            size = (view_prior.size if isinstance(view_prior, FacePrior) else coarse_size)(*mask.shape[:2])
            nothing = torch.zeros(*size, 6, dtype=torch.float16)
            result.append(ClippedLight(nothing, nothing[..., 3:]))
            continue
        exposure = response.decode(torch.from_numpy(view.image).to(device)).float() / response.white
        file_light = view.light_above_white
        file_light = None if file_light is None else torch.from_numpy(file_light).to(device).float()
        deviation = view.light_above_white_deviation
        light = combined_estimates(exposure, mask.to(device), view_prior, file_light, deviation)
        result.append(ClippedLight(by_solid_angle(light.log_light.cpu(), view.camera), light.certainty.cpu()))
    return result


def by_solid_angle(estimates: Tensor, camera: Camera) -> Tensor:
    """Return estimates [h, w, 6] whose squared weights are multiplied by the solid angles of the camera's pixels."""
    if camera.is_pinhole:
        return estimates
    angles = torch.from_numpy(solid_angles(camera))
    weights = F.interpolate(angles[None, None], size=estimates.shape[:2], mode="area")[0, 0, :, :, None]
    weights = (weights / angles.mean().clamp_min(1e-6)).sqrt()
    return torch.cat([estimates[..., :3], (estimates[..., 3:] * weights).to(estimates)], 2)


@dataclass(frozen=True)
class _Face:
    """A perspective view within a wide photo, and where the photo's pixels lie in it."""

    places: Tensor  # [1, S, S, 2] pixels of the photo that the face shows, as grid_sample takes them
    visible: Tensor  # [S, S, 1] float32, 0 where the lens shows nothing
    back: Tensor  # [1, h, w, 2] places in the face of the photo's pixels
    weights: Tensor  # [h, w, 1] float32, 0 for pixels that the face does not show


class FacePrior:
    """The prior for the photos of one camera that is not a pinhole, by perspective faces that overlap."""

    def __init__(self, prior: LightPrior, camera: Camera):
        """Prepare the faces of a panorama or of a photo by a fisheye lens, whose light the prior estimates."""
        self.prior, self.camera = prior, camera
        self._faces: list[_Face] | None = None

    def fits(self, camera: Camera) -> bool:
        """Return whether a camera differs from this one by its pose alone."""
        own, other = self.camera, camera
        same = (own.width, own.height, own.projection, own.distortion) == (
            other.width, other.height, other.projection, other.distortion
        )  # fmt: skip
        return same and bool((own.intrinsics == other.intrinsics).all())

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Return the size of an estimate: that at which a face has at most LARGEST pixels."""
        part = min(1.0, LARGEST / face_size(self.camera))
        return max(1, round(height * part)), max(1, round(width * part))

    @torch.no_grad()
    def estimate(self, exposure: Tensor, clipped: Tensor) -> LightEstimate:
        """Estimate the light of a photo's clipped values, as LightPrior.estimate does; at the size of `size`."""
        size = self.size(*exposure.shape[:2])
        picture = torch.cat([exposure, clipped.to(exposure)], 2).permute(2, 0, 1)[None]
        picture = F.interpolate(picture, size=size, mode="area")
        if self._faces is None:
            self._faces = _faces(self.camera.resized(size[1], size[0]), exposure.device)
        wrapped = self.camera.projection == "equirectangular"
        total, weight = torch.zeros(*size, 6, device=exposure.device), torch.zeros(*size, 1, device=exposure.device)
        padded = F.pad(picture, (1, 1, 0, 0), mode="circular" if wrapped else "replicate")
        for face in self._faces:
            view = F.grid_sample(padded, face.places, padding_mode="border", align_corners=False)
            view = view[0].permute(1, 2, 0) * face.visible
            if not bool((view[..., 3:] > 0).any()):
                continue
            estimate_of_view = self.prior.estimate(view[..., :3], view[..., 3:])
            both = torch.cat([estimate_of_view.mean, estimate_of_view.deviation], 2).permute(2, 0, 1)[None]
            back = F.grid_sample(both, face.back, padding_mode="border", align_corners=False)
            total += face.weights * back[0].permute(1, 2, 0)
            weight += face.weights
        mean, deviation = (total / weight.clamp_min(1e-6)).split(3, dim=2)
        return LightEstimate(mean, torch.where(weight > 0, deviation, 1.0))


def _faces(camera: Camera, device: torch.device) -> list[_Face]:
    """Return faces around the camera every 45 degrees, above and below, as far as it shows them."""
    count = face_size(camera)
    focal = count / 2 / np.tan(np.radians(FACE_ANGLE / 2))
    face = Camera(count, count, focal, focal, count / 2, count / 2, np.eye(4))
    rays, directions = pixel_directions(face), np.nan_to_num(pixel_directions(camera))
    faces = []
    for turn in _rotations():
        places = pixels_of_directions(rays @ turn, camera)
        visible = np.asarray(np.isfinite(places).all(axis=2))
        local = directions @ turn.T
        depth = np.maximum(local[..., 2], 1e-6)
        columns, rows = (focal * local[..., axis] / depth + count / 2 for axis in (0, 1))
        # Half a pixel more, because a direction between two faces would be in neither of them.
        across = np.abs(np.stack([columns, rows]) - count / 2).max(axis=0)
        inside = (local[..., 2] > 1e-6) & (across <= (count + 1) / 2)
        weights = inside * np.maximum(local[..., 2], 0) ** _SHARPNESS
        # Of the first center (0, 0) with a column beside it, and of the first corner; from -1 to 1 in both.
        at = np.stack([(places[..., 1] + 1.5) / (camera.width + 2), (places[..., 0] + 0.5) / camera.height], axis=-1)
        back = np.stack([columns, rows], axis=-1) / count
        tensors = (2 * np.nan_to_num(at)[None] - 1, visible[..., None], 2 * back[None] - 1, weights[..., None])
        faces.append(_Face(*(torch.tensor(values, dtype=torch.float32, device=device) for values in tensors)))
    return [each for each in faces if bool(each.visible.any())]


def _rotations() -> np.ndarray:
    """Return [10, 3, 3] rotations from the axes of a photo to those of its faces."""
    half = np.sqrt(0.5)
    eighth = np.array([[half, 0, -half], [0, 1, 0], [half, 0, half]])
    turns = face_rotations()
    return np.concatenate([turns, eighth @ turns[:4]])
