"""What a reader finds in a data folder, before any pixel is decoded."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from .lens import Lens

DERIVED_PHOTOS = "reinhard-gamma"
"""What a set of truth alone states as `photo_response`: its photos are made of the truth by this curve."""


def reinhard_gamma(exposure: np.ndarray) -> np.ndarray:
    """HDR-NeRF's synthetic response: (x / (1 + x))^(1 / 2.2), exposure x >= 0 -> [0, 1)."""
    exposure = np.maximum(exposure, 0.0)
    return (exposure / (1.0 + exposure)) ** (1 / 2.2)


@dataclass(frozen=True)
class Shot:
    """One photo of one view.

    view: the key that photos of one view at several exposures share; becomes the view's name.
    image, mask, hdr: files. lens, world_to_camera: the camera; [4, 4] float64, rigid.
    exposure_key: the exposure's number where a view has several (the k of `<view>_<k>.png`); None otherwise.
    exposure_time: seconds from the set's own files; None lets EXIF speak. split: "train" or "test", if stated.
    derived: the set has no photos; this one is made of the truth, and `image` names the truth's file.
    linear: the codes are proportional to light, and become those of sRGB.
    oriented: the lens speaks of the pixels after EXIF orientation; None finds out from the sizes.
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
    oriented: bool | None = None

    @property
    def seconds(self) -> float:
        """The exposure time, once the set's files or EXIF have told it."""
        assert self.exposure_time is not None
        return self.exposure_time


Cloud = tuple[np.ndarray, np.ndarray]
"""[P, 3] float64 places and [P, 3] float32 encoded colors in [0, 1]."""
NO_POINTS: Cloud = np.zeros((0, 3)), np.zeros((0, 3), np.float32)


@dataclass(frozen=True)
class Capture:
    """A data folder as read.

    format, notes: as Scene's. cloud: its points and their colors. name, folder: what was asked for, and where it lies.
    alpha: what transparency means: "background" (nothing there: composite over black light) or "mask" (not observed).
    holdout: (every so many views, from this one) is held out in the protocol that the layout is published with; None
        for a layout without one.
    times_known: False where no file stated exposure times.
    kind: of the photos: encoded, linear, raw or float; see linear_photos.py.
    """

    format: str
    shots: tuple[Shot, ...]
    alpha: str = "mask"
    holdout: tuple[int, int] | None = None
    cloud: Cloud = NO_POINTS
    notes: tuple[str, ...] = ()
    name: str = ""
    folder: Path = Path()
    times_known: bool = True
    kind: str = "encoded"

    @property
    def training(self) -> tuple[Shot, ...]:
        return tuple(shot for shot in self.shots if shot.split == "train")


def pose_from_quaternion(quaternion, translation, source: Path, name: str) -> np.ndarray:
    """[4, 4] world_to_camera from COLMAP's (w, x, y, z) and t; InputError where not finite or zero."""
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
    """[4, 4] world_to_camera from a 3 x 4 or 4 x 4 camera-to-world matrix in OpenCV axes, its rotation made proper.

    InputError for another shape, values that are not finite, scale (beyond 1e-3), shear or reflection.
    """
    remedy = "export the poses again without scale"
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise InputError(source, f"pose of {name!r:.90} is not a finite 4 x 4 matrix", remedy)
    u, stretch, vt = np.linalg.svd(matrix[:3, :3])
    rotation = u @ vt
    if np.abs(stretch - 1).max() > 1e-3 or np.linalg.det(rotation) < 0:
        problem = f"pose of {name!r:.90} is no rotation (stretch {np.round(stretch, 4).tolist()})"
        raise InputError(source, problem, remedy)
    if not np.abs(matrix[:3, 3]).max() < 1e12:
        raise InputError(source, f"position of {name!r:.90} is {matrix[:3, 3].tolist()}", "check the units")
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ matrix[:3, 3]
    return pose
