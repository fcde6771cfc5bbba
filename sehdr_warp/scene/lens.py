"""Cameras with lens distortion, and undistortion of photos to pinhole cameras."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..parallel import preserve_signals
from .camera import FISHEYES, MAX_FOCAL, Camera
from .wide_camera import WIDEST_PINHOLE, fisheye_angles

# COLMAP's camera models by their number in binary files: name, number of parameters (src/colmap/sensor/models.h).
CAMERA_MODELS = dict(enumerate((
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4),
    ("EUCM", 6), ("EQUIRECTANGULAR", 2),
)))  # fmt: skip
PARAMETER_COUNTS = dict(CAMERA_MODELS.values())

_ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE",
              "SIMPLE_DIVISION", "SIMPLE_FISHEYE"}  # fmt: skip
# Models that are pinholes if every parameter after the principal point, if there is one, is zero.
_NEUTRAL_AT_ZERO = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV",
                    "SIMPLE_DIVISION", "DIVISION"}  # fmt: skip
_SPHERE = "EQUIRECTANGULAR"
_SKEW = 0.01  # Part of its width by which a panorama may differ from twice its height
_MAX_SIDE = 1 << 16
_LEAST_FOCAL = 0.02  # Of the longer side; the widest fisheye lenses have 0.13


@dataclass(frozen=True)
class Lens:
    """A camera's intrinsics as a data set states them.

    Raises:
        InputError: for an unknown model, a wrong number of parameters, a size outside 1..65536 or bad values.
    """

    model: str  # One of CAMERA_MODELS
    width: int  # Of the images that params refer to, in pixels
    height: int  # Of the images that params refer to, in pixels
    params: tuple[float, ...]  # In COLMAP's order; the centre of the top left pixel is (0.5, 0.5)
    source: Path  # The file that states them

    def __post_init__(self):
        """Check the values."""
        remedy, count, problem = "correct the camera or export it again", PARAMETER_COUNTS.get(self.model), None
        if count is None:
            problem = f"camera model {self.model!r:.40} is not supported"
            remedy = f"use one of {', '.join(PARAMETER_COUNTS)}"
        elif len(self.params) != count:
            problem = f"camera model {self.model} has {len(self.params)} parameters, not {count}"
        elif not (1 <= self.width <= _MAX_SIDE and 1 <= self.height <= _MAX_SIDE):
            problem = f"camera size {self.width} x {self.height} is not in 1..{_MAX_SIDE}"
        elif not np.isfinite(self.params).all():
            problem = f"camera parameters {self.params} are not finite"
        elif self.model == _SPHERE and abs(self.width - 2 * self.height) > max(2.0, _SKEW * self.width):
            problem = f"equirectangular photos are {self.width} x {self.height}, not twice as wide as high"
            remedy = "export whole panoramas (360 x 180 degrees)"
        elif min(self.focal) <= 0:
            problem = f"focal lengths {self.focal} are not positive"
        elif max(self.focal) > MAX_FOCAL:
            problem = f"focal lengths {self.focal} are longer than {MAX_FOCAL:g} pixels"
        elif max(self.focal) < _LEAST_FOCAL * max(self.width, self.height):
            problem = f"focal lengths {self.focal} are too short for {self.width} x {self.height} pixels"
            remedy = "state focal lengths and principal point in pixels"
        if problem:
            raise InputError(self.source, problem, remedy)

    @property
    def focal_count(self) -> int:
        """Number of focal lengths in front of the principal point in params."""
        return 1 if self.model in _ONE_FOCAL else 2

    @property
    def focal(self) -> tuple[float, float]:
        """Focal lengths (fx, fy) in pixels; of a panorama pixels per radian."""
        if self.model == _SPHERE:
            return (self.width / (2 * np.pi),) * 2  # pyright: ignore[reportReturnType]
        return (self.params[0], self.params[0]) if self.model in _ONE_FOCAL else (self.params[0], self.params[1])

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point (cx, cy) in pixels."""
        if self.model == _SPHERE:
            return self.width / 2, self.height / 2
        return self.params[self.focal_count], self.params[self.focal_count + 1]

    @property
    def projection(self) -> str:
        """Projection that the photos are used in, as Camera.projection; a fisheye that sees too much keeps its own."""
        if self.model == _SPHERE:
            return "equirectangular"
        if self.model not in FISHEYES:
            return "pinhole"
        (fx, _), (cx, _) = self.focal, self.centre
        radii = np.array([cx, self.width - cx]) / fx
        angle = float(np.degrees(fisheye_angles(self.model, self._distortion, radii).sum()))
        return self.model if not angle <= WIDEST_PINHOLE else "pinhole"

    @property
    def _distortion(self) -> tuple[float, ...]:
        return tuple(self.params[self.focal_count + 2 :])

    @property
    def is_pinhole(self) -> bool:
        """True if the photos need no undistortion."""
        if self.projection != "pinhole":
            return True
        return self.model in _NEUTRAL_AT_ZERO and not any(self._distortion)

    def resized(self, width: int, height: int) -> "Lens":
        """Return the same lens for images of another size; distortion parameters do not depend on it."""
        sx, sy = width / self.width, height / self.height
        params = list(self.params)
        if self.model == _SPHERE:
            params = [float(width), float(height)]
        elif self.model in _ONE_FOCAL:
            params[0:3] = params[0] * (sx + sy) / 2, params[1] * sx, params[2] * sy
        else:
            params[0:4] = params[0] * sx, params[1] * sy, params[2] * sx, params[3] * sy
        return Lens(self.model, width, height, tuple(params), self.source)

    def camera(self, world_to_camera: np.ndarray) -> Camera:
        """Return the camera at a pose, at the photos' size; without distortion unless the lens is too wide for that."""
        (fx, fy), (cx, cy), projection = self.focal, self.centre, self.projection
        distortion = self._distortion if projection in FISHEYES else ()
        return Camera(self.width, self.height, fx, fy, cx, cy, world_to_camera, projection, distortion)


class Undistortion:
    """Bilinear resampling of the photos of one lens to the pinhole camera that COLMAP's undistorter chooses.

    Attributes:
        inside: [H, W] bool, True where the lens imaged something; None if it did everywhere.
        share: part of the photos' area that is left; more than half for lenses that exist.
    """

    def __init__(self, lens: Lens):
        """Compute the map; raise InputError if the distortion cannot be inverted."""
        with preserve_signals():
            import pycolmap

        described = f"distortion {lens.model} {lens.params}"
        try:
            bent = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
            target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), bent)
            fx, fy, cx, cy = target.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]]
            width, height = int(target.width), int(target.height)
            if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE and np.isfinite([fx, fy, cx, cy]).all()):
                raise ValueError(f"size {width} x {height}, focal length {fx}")
            columns, rows = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
            rays = np.stack([*np.meshgrid(columns, rows), np.ones((height, width))], axis=2)
            places = np.asarray(bent.img_from_cam(rays.reshape(-1, 3))).reshape(height, width, 2)
        except (ValueError, RuntimeError, OverflowError, MemoryError) as error:
            raise InputError(lens.source, f"{described} cannot be undone ({error})",
                             "undistort the images with COLMAP's image_undistorter first") from None  # fmt: skip
        self.intrinsics = (width, height, float(fx), float(fy), float(cx), float(cy))
        inside = np.asarray((np.isfinite(places) & (places >= 0) & (places <= (lens.width, lens.height))).all(axis=2))
        if not inside.any():
            raise InputError(lens.source, f"{described} leaves no pixel of the image", "correct its parameters")
        self.share = float(np.prod(np.ptp(places[inside], axis=0) / (lens.width, lens.height)))
        # From COLMAP's pixel centers at 0.5 to array indices; coordinates as (row, column).
        self._places = np.where(inside, places.transpose(2, 0, 1)[::-1] - 0.5, 0).astype(np.float32)
        self.inside: np.ndarray | None = None if inside.all() else inside

    def camera(self, world_to_camera: np.ndarray) -> Camera:
        """Return the pinhole camera of a pose."""
        return Camera(*self.intrinsics, world_to_camera)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Resample [H, W] or [H, W, C] float32 to the pinhole camera, 0 outside of the lens's image."""
        from scipy.ndimage import map_coordinates

        result = np.empty((*self._places.shape[1:], *image.shape[2:]), np.float32)
        for channel in np.ndindex(image.shape[2:]):
            plane = image[(..., *channel)]
            result[(..., *channel)] = map_coordinates(plane, self._places, order=1, mode="nearest", output=np.float32)
        if self.inside is not None:
            result[~self.inside] = 0.0
        return result
