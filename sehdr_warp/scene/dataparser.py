"""Results of a dataparser before any pixel is decoded: cameras, files, exposure times, points."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from .color.encoding import ColorEncoding
from .lens import Lens

DERIVED_PHOTOS = "reinhard-gamma"
"""Value of `photo_response` in a set without photos: its photos are computed from the truth by this curve."""


def reinhard_gamma(exposure: np.ndarray) -> np.ndarray:
    """Encode exposure by HDR-NeRF's synthetic response, (x / (1 + x))^(1 / 2.2): x >= 0 to [0, 1)."""
    exposure = np.maximum(exposure, 0.0)
    return (exposure / (1.0 + exposure)) ** (1 / 2.2)


@dataclass(frozen=True)
class ImageRecord:
    """One photo of one view.

    Attributes:
        view: key that photos of one view at several exposures share; becomes the view's name.
        image: the photo's file.
        lens: intrinsics.
        world_to_camera: [4, 4] float64, rigid.
        exposure_key: the exposure's number if a view has several (the k of `<view>_<k>.png`); None otherwise.
        exposure_time: seconds from the set's own files; None if only EXIF may state it.
        split: "train" or "test", if the set states it.
        mask: its mask file.
        hdr: its file of HDR truth.
        derived: the set has no photos; this one is computed from the truth, and `image` is the truth's file.
        linear: the user says that the photo's codes are proportional to light; they are re-encoded by sRGB's curve.
        gain_map_scale: the photo's light is taken from its gain map and re-encoded by sRGB's curve; to hold light above
            white, its codes and exposure_time are smaller by this factor. None if the light is that of the codes.
        encoding: what the photo's file states of its colors; None if it states nothing.
        light_scale: factor from the values of a float photo to the light of the set, by the times that files state.
        time_known: False if exposure_time is only a guess, to be replaced by comparing light with other photos.
        oriented: the lens refers to the pixels after EXIF orientation; None decides by the sizes.
        uncertain: structure from motion placed the camera by few points.
    """

    view: str
    image: Path
    lens: Lens
    world_to_camera: np.ndarray
    exposure_key: int | None = None
    exposure_time: float | None = None
    split: str | None = None
    mask: Path | None = None
    hdr: Path | None = None
    derived: bool = False
    linear: bool = False
    gain_map_scale: float | None = None
    encoding: ColorEncoding | None = None
    light_scale: float = 1.0
    time_known: bool = True
    oriented: bool | None = None
    uncertain: bool = False

    @property
    def seconds(self) -> float:
        """The exposure time in seconds, after with_exposure_times() has set it."""
        assert self.exposure_time is not None
        return self.exposure_time

    @property
    def is_own_truth(self) -> bool:
        """True for a float image, and for a photo that is derived: `image` is the file of truth."""
        return self.hdr == self.image


class PlacedPhoto(NamedTuple):
    """A photo of a run whose camera structure from motion found."""

    file: str  # Its name
    lens: Lens
    world_to_camera: np.ndarray
    split: str
    exposure_time: float  # Seconds


UNPLACED = Lens("SIMPLE_PINHOLE", 1, 1, (1.0, 0.5, 0.5), Path("photos without cameras"))
"""The lens of photos before structure from motion."""


class PointCloud(NamedTuple):
    """Sparse points of a set."""

    positions: np.ndarray  # [P, 3] float64 world coordinates
    colors: np.ndarray  # [P, 3] float32 encoded values in [0, 1]


NO_POINTS = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))


@dataclass(frozen=True)
class DataparserOutputs:
    """A data folder as parsed."""

    format: str  # The layout; see Scene
    records: tuple[ImageRecord, ...]  # The photos
    alpha: str = "mask"  # Transparency is "background" (black light) or "mask" (not observed)
    holdout: tuple[int, int] | None = None  # (step, offset) of the layout's published held-out views; or None
    cloud: PointCloud = NO_POINTS  # The points that come with the set
    notes: tuple[str, ...] = ()  # See Scene
    name: str = ""  # What the user asked for
    folder: Path = Path()  # Where the set lies
    times_known: bool = True  # False if no file states exposure times
    kind: str = "encoded"  # encoded, linear, gain-map, raw or float; see file_kind(), response_choice.py
    stated_response: str | None = None  # That files state (a video's log curve); None without one
    color_matrix: np.ndarray | None = None  # [3, 3] from the photos' light to linear Rec.709; None if the same
    within_rec709: bool = False  # The stated response's light is in Rec.709, to which photos are converted
    mentioned: tuple[str, ...] = ()  # Names of photos that a note names, and that are in no record
    unplaced: int = 0  # Number of photos that structure from motion could not place, which are in no record

    @property
    def training(self) -> tuple[ImageRecord, ...]:
        """The photos to train on."""
        return tuple(record for record in self.records if record.split == "train")


def pose_from_quaternion(quaternion, translation, source: Path, name: str) -> np.ndarray:
    """Return world_to_camera [4, 4] from COLMAP's quaternion (w, x, y, z) and translation.

    Raises:
        InputError: if they are not finite, or the quaternion's length is near 0 or very large.
    """
    from scipy.spatial.transform import Rotation

    length = np.linalg.norm(quaternion)
    if not (np.isfinite(length) and np.isfinite(translation).all()):
        raise InputError(source, f"pose of {name!r:.90} is not finite", "remove the image or export the model again")
    if not 1e-8 < length < 1e8:
        raise InputError(source, f"quaternion of {name!r:.90} has length {length:g}", "export the model again")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix(), translation
    return pose


def pose_from_camera_to_world(matrix, source: Path, name: str) -> np.ndarray:
    """Return world_to_camera [4, 4] from a camera-to-world matrix in OpenCV axes, with the nearest rotation.

    The matrix is 3 x 4 or 4 x 4; errors name the file `source` and the image `name`.

    Raises:
        InputError: for another shape, values that are not finite, a position in the last row, or axes of other
            lengths (beyond 1e-3), shear or reflection. One scale of all axes, as of a camera in Blender, is left out.
    """
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise InputError(source, f"pose of {name!r:.90} is not a finite 4 x 4 matrix", "export the poses again")
    if len(matrix) == 4 and np.abs(matrix[3, :3]).max() > 1e-3:
        problem = f"pose of {name!r:.90} has the last row {matrix[3].tolist()}, not 0 0 0 1"
        raise InputError(source, problem, "transpose the matrix if it states the position there")
    u, stretch, vt = np.linalg.svd(matrix[:3, :3])
    rotation = u @ vt
    if np.linalg.det(rotation) < 0:
        remedy = "export the poses again with right-handed axes"
        raise InputError(source, f"pose of {name!r:.90} mirrors the scene", remedy)
    if not stretch[2] > 1e-6 or stretch[0] > 1.002 * stretch[2]:
        problem = f"pose of {name!r:.90} is not a rotation (stretch {np.round(stretch, 4).tolist()})"
        raise InputError(source, problem, "export the poses again without scale")
    if not np.abs(matrix[:3, 3]).max() < 1e12:
        raise InputError(source, f"position of {name!r:.90} is {matrix[:3, 3].tolist()}", "check the units")
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ matrix[:3, 3]
    return pose
