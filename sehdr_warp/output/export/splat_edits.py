"""Edits of Gaussians on their way into a file: what is never drawn, strays, crops, and what too few photos show."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...errors import SehdrError, require_number, require_whole_number
from ...model.visibility import contributions, count_views, mask_shares
from ...runs.run import RenderableScene
from ...scene import Camera, View
from ...scene.camera_focus import camera_positions, common_focus
from ...scene.wide_camera import painted_mask
from ...splats import GaussianArrays
from ..cameras.scene_cameras import training_cameras

log = logging.getLogger(__name__)
LEAST_OPACITY = 1 / 255  # Opacity below which 3DGS rasterizers, this one included, draw nothing
# Gaussians farther from the cameras than this many times their reach are moved to that distance and shrunk alike: as
# seen from the middle nothing changes, and from the other cameras it shifts by less than 1/100 rad. Viewers sort by
# depth over a file's whole extent, so a single stray would cost the rest its order.
FAR = 100.0
_LEAST_SHARE = 0.5  # Part of a Gaussian's pixels in photos with masks that the masks must keep
_FAINT = 0.05  # Strays of less opacity than this are dropped instead


@dataclass(frozen=True)
class Box:
    """An axis-aligned box; `low` and `high` are [3]."""

    low: np.ndarray
    high: np.ndarray

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return [N] whether points [N, 3] are inside."""
        return ((points >= self.low) & (points <= self.high)).all(axis=1)  # pyright: ignore[reportReturnType]


@dataclass(frozen=True)
class Sphere:
    """A sphere; `center` is [3]."""

    center: np.ndarray
    radius: float

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return [N] whether points [N, 3] are inside."""
        return np.linalg.norm(points - self.center, axis=1) <= self.radius


def read_region(text: str) -> Box | Sphere:
    """Return the region that "box:x0,y0,z0,x1,y1,z1" or "sphere:x,y,z,radius" describes.

    Raises:
        SehdrError: If it is neither, or is empty.
    """
    kind, _, numbers = text.partition(":") if isinstance(text, str) else ("", "", "")
    try:
        values = np.array([float(number) for number in numbers.split(",")])
    except ValueError:
        values = np.array([])
    if np.isfinite(values).all():
        if kind == "sphere" and values.shape == (4,) and values[3] > 0:
            return Sphere(values[:3], float(values[3]))
        if kind == "box" and values.shape == (6,) and (values[:3] != values[3:]).all():
            return Box(np.minimum(values[:3], values[3:]), np.maximum(values[:3], values[3:]))
    raise SehdrError(f"region {text!r:.90} is not box:x0,y0,z0,x1,y1,z1 or sphere:x,y,z,radius")


@dataclass(frozen=True)
class SplatEdits:
    """Gaussians that a file leaves out.

    Attributes:
        crop: Region to keep (see read_region), in the coordinates of `axes`, by default upright ones.
        cut: Region to leave out, in the same coordinates.
        min_opacity: Least opacity of a Gaussian, in [0, 1).
        min_views: Least number of training cameras that show a Gaussian; 2 removes most floaters.
        max_gaussians: Number of Gaussians to keep, those that contribute most to the training views.
        mask_views: Photos with masks: what shows mostly outside of these is left out. None for no such edit.
    """

    crop: str | None = None
    cut: str | None = None
    min_opacity: float = LEAST_OPACITY
    min_views: int = 0
    max_gaussians: int | None = None
    mask_views: Sequence[View] | None = None

    def __post_init__(self):
        """Raise SehdrError for values that cannot be, and TypeError for those of another type."""
        for region in (self.crop, self.cut):
            if region not in (None, ""):
                read_region(region)
        require_number(self.min_opacity, "min_opacity")
        require_whole_number(self.min_views, "min_views")
        if not 0 <= self.min_opacity < 1:
            raise SehdrError(f"min_opacity {self.min_opacity} is not at least 0 and below 1")
        if self.min_views < 0:
            raise SehdrError(f"min_views {self.min_views} is negative; 2 leaves out what a single camera shows")
        if self.max_gaussians is not None:
            require_whole_number(self.max_gaussians, "max_gaussians", 1)
        views = () if self.mask_views is None else self.mask_views
        if not (isinstance(views, Sequence) and all(isinstance(view, View) for view in views)):
            raise TypeError(f"mask_views is {self.mask_views!r:.60}, expected views of a scene, as scene.views")
        if self.mask_views is not None and all(painted_mask(view) is None for view in self.mask_views):
            remedy = "paint masks/PHOTO.png beside the photos, white where the object is"
            raise SehdrError(f"no photo has a mask that leaves out pixels; {remedy}")

    @property
    def shows_part(self) -> bool:
        """True if the file shows a part of the scene, so that pictures of the whole do not tell what it lost."""
        return bool(self.crop or self.cut or self.mask_views is not None)

    @property
    def changes_pictures(self) -> bool:
        """True if the file shows less than the scene: a part, or the scene without floaters or haze."""
        return bool(self.shows_part or self.min_views or self.min_opacity > LEAST_OPACITY)

    def mask(self, opacities: np.ndarray, means: np.ndarray, run: RenderableScene) -> np.ndarray:
        """Return [N], which Gaussians stay.

        Args:
            opacities: [N] of the run's Gaussians, in [0, 1].
            means: [N, 3] their positions in the coordinates of the regions.
            run: The scene, whose training cameras count views.

        Raises:
            SehdrError: If none stays, or views are to be counted and the scene has no cameras.
        """
        too_faint = self.min_opacity <= LEAST_OPACITY
        faint = "too faint for any program to draw" if too_faint else f"of opacity below {self.min_opacity:g}"
        steps = {faint: opacities < self.min_opacity} | self._outside(means)
        if self.min_views:
            cameras = training_cameras(run)
            if not cameras:
                raise SehdrError(f"{run.path}: has no training cameras to count views of; leave min_views out")
            views = count_views(run.field, cameras).cpu().numpy()
            steps[f"shown by fewer than {self.min_views} cameras"] = views < self.min_views
        if self.mask_views is not None:
            masked = [view for view in self.mask_views if painted_mask(view) is not None]
            steps["outside of the masks"] = mask_shares(run.field, masked).cpu().numpy() < _LEAST_SHARE
        mask = np.ones(len(opacities), bool)
        for reason, goes in steps.items():
            mask &= ~goes
            if goes.any():
                log.info("left out: %d Gaussians (%.0f %%) %s", goes.sum(), 100 * goes.mean(), reason)
        if not mask.any():
            raise _empty_file_error(means)
        return mask

    def check_regions(self, means: np.ndarray) -> None:
        """Raise SehdrError if crop and cut leave none of the Gaussians at means [N, 3]."""
        if np.any([np.zeros(len(means), bool), *self._outside(means).values()], axis=0).all():
            raise _empty_file_error(means)

    def _outside(self, means: np.ndarray) -> dict[str, np.ndarray]:
        """Return [N] which Gaussians crop and cut remove, by what the log says of them."""
        steps = {}
        if self.crop:
            steps[f"outside of {self.crop}"] = ~read_region(self.crop).contains(means)
        if self.cut:
            steps[f"inside of {self.cut}"] = read_region(self.cut).contains(means)
        return steps


def _empty_file_error(means: np.ndarray) -> SehdrError:
    low, high = (np.percentile(means, q, axis=0) for q in (2, 98))
    extent = " to ".join(", ".join(f"{v:.3g}" for v in corner) for corner in (low, high))
    return SehdrError(f"these edits leave no Gaussian; the scene lies at {extent} in the coordinates of these regions")


def most_visible(mask: np.ndarray, count: int, run: RenderableScene) -> np.ndarray:
    """Return [N], which of the Gaussians that stay are the `count` that contribute most to the training views.

    Raises:
        SehdrError: If the scene has no training cameras.
    """
    if mask.sum() <= count:
        return mask
    cameras = training_cameras(run)
    if not cameras:
        raise SehdrError(f"{run.path}: has no training cameras to measure contributions with; leave max_gaussians out")
    share = np.where(mask, contributions(run.field, cameras).cpu().numpy(), -1)
    largest = np.zeros(len(mask), bool)
    largest[np.argsort(-share, kind="stable")[:count]] = True
    removed_rows = mask & ~largest
    part = share[removed_rows].sum() / max(share[mask].sum(), 1e-12)
    log.info("left out: %d Gaussians that make %.1f %% of the pictures", removed_rows.sum(), 100 * part)
    return largest


def without_strays(gaussians: GaussianArrays, cameras: Sequence[Camera]) -> GaussianArrays:
    """Return Gaussians without strays: beyond FAR times the cameras' reach faint ones go and others come nearer.

    They are in the coordinates of the training cameras; without cameras nothing changes.
    """
    if not cameras:
        return gaussians
    positions = camera_positions(cameras)
    center = np.median(positions, axis=0)
    reach = float(np.percentile(np.linalg.norm(positions - center, axis=1), 90))
    focus = common_focus(cameras)
    if focus is not None:
        reach = max(reach, float(np.linalg.norm(focus - center)))
    offsets = gaussians.means.astype(np.float64) - center
    distance, limit = np.linalg.norm(offsets, axis=1), FAR * reach
    far = distance > limit
    if limit <= 0 or not far.any():
        return gaussians
    faint = far & (gaussians.opacities < _FAINT)
    factor = np.where(far, limit / np.maximum(distance, 1e-12), 1.0)
    moved = replace(
        gaussians,
        means=(center + offsets * factor[:, None]).astype(gaussians.means.dtype),
        log_scales=(gaussians.log_scales + np.log(factor)[:, None]).astype(np.float32),
        filters=None if gaussians.filters is None else (gaussians.filters * factor).astype(np.float32),
    )
    text = "strays: %d Gaussians beyond %.3g units: %d faint ones left out, %d moved there"
    log.info(text, far.sum(), limit, faint.sum(), (far & ~faint).sum())
    return moved.rows(~faint)
