"""Cameras as photographed, with lens distortion, and the pinhole cameras that their photos are resampled to."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sehdr_warp.errors import InputError

from .camera import Camera

# COLMAP's camera models: identity in binary files -> (name, number of parameters), src/colmap/sensor/models.h.
CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
}
PARAMETER_COUNTS = dict(CAMERA_MODELS.values())

_ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE",
              "SIMPLE_DIVISION", "SIMPLE_FISHEYE"}  # fmt: skip
_PINHOLES = {"SIMPLE_PINHOLE", "PINHOLE"}
# Models that are pinholes where every parameter after the principal point is zero.
_NEUTRAL_AT_ZERO = {"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION"}
_MAX_SIDE = 1 << 16


@dataclass(frozen=True)
class Lens:
    """A camera's intrinsics as a data set states them.

    model: one of COLMAP's camera models (CAMERA_MODELS).
    width, height: size in pixels of the images that params speak of.
    params: the model's parameters in COLMAP's order; the centre of the top left pixel is (0.5, 0.5).
    source: the file that states them, for messages.

    Raises InputError for an unknown model, a wrong number of parameters, a size outside 1..65536 or bad values.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    source: Path

    def __post_init__(self):
        remedy = "correct the camera or export it again"
        if self.model not in PARAMETER_COUNTS:
            raise InputError(self.source, f"camera model {self.model!r:.40} is not supported",
                             f"use one of {', '.join(PARAMETER_COUNTS)}")  # fmt: skip
        if len(self.params) != PARAMETER_COUNTS[self.model]:
            raise InputError(self.source, f"camera model {self.model} has {len(self.params)} parameters, not "
                             f"{PARAMETER_COUNTS[self.model]}", remedy)  # fmt: skip
        if not (1 <= self.width <= _MAX_SIDE and 1 <= self.height <= _MAX_SIDE):
            raise InputError(self.source, f"camera size {self.width} x {self.height} is not in 1..{_MAX_SIDE}", remedy)
        if not np.isfinite(self.params).all():
            raise InputError(self.source, f"camera parameters {self.params} are not finite", remedy)
        if self.focal[0] <= 0 or self.focal[1] <= 0:
            raise InputError(self.source, f"focal lengths {self.focal} are not positive", remedy)

    @property
    def focal(self) -> tuple[float, float]:
        return (self.params[0], self.params[0]) if self.model in _ONE_FOCAL else (self.params[0], self.params[1])

    @property
    def centre(self) -> tuple[float, float]:
        first = 1 if self.model in _ONE_FOCAL else 2
        return self.params[first], self.params[first + 1]

    @property
    def is_pinhole(self) -> bool:
        """True where the photos need no resampling."""
        if self.model in _PINHOLES:
            return True
        first = 3 if self.model in _ONE_FOCAL else 4
        return self.model in _NEUTRAL_AT_ZERO and not any(self.params[first:])

    def resized(self, width: int, height: int) -> "Lens":
        """The same lens for images of another size; distortion parameters are free of the scale."""
        sx, sy = width / self.width, height / self.height
        params = list(self.params)
        if self.model in _ONE_FOCAL:
            params[0:3] = params[0] * (sx + sy) / 2, params[1] * sx, params[2] * sy
        else:
            params[0:4] = params[0] * sx, params[1] * sy, params[2] * sx, params[3] * sy
        return Lens(self.model, width, height, tuple(params), self.source)

    def pinhole(self, world_to_camera: np.ndarray) -> Camera:
        """The camera without its distortion parameters, at the same size."""
        return Camera(self.width, self.height, *self.focal, *self.centre, world_to_camera)


class Undistortion:
    """Resamples photos taken through one distorting lens to the pinhole camera that shows only real pixels.

    The projection and the choice of the pinhole camera (size and focal length, no blank border) are pycolmap's;
    the resampling is bilinear, on float images. Raises InputError where the lens cannot be undone.
    """

    def __init__(self, lens: Lens):
        import pycolmap

        distorted = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
        try:
            target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), distorted)
            width, height = int(target.width), int(target.height)
            fx, fy = target.focal_length_x, target.focal_length_y
            cx, cy = target.principal_point_x, target.principal_point_y
            if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE and np.isfinite([fx, fy, cx, cy]).all()):
                raise ValueError(f"size {width} x {height}, focal length {fx}")
            columns, rows = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
            rays = np.stack([*np.meshgrid(columns, rows), np.ones((height, width))], axis=2).reshape(-1, 3)
            places = np.asarray(distorted.img_from_cam(rays)).reshape(height, width, 2)
        except (ValueError, RuntimeError, OverflowError, MemoryError) as error:
            raise InputError(lens.source, f"distortion {lens.model} {lens.params} cannot be undone ({error})",
                             "undistort the images with COLMAP's image_undistorter first") from None  # fmt: skip
        self.intrinsics = (width, height, float(fx), float(fy), float(cx), float(cy))
        # From COLMAP's pixel centres at 0.5 to array indices; coordinates as (row, column).
        self._places = np.stack([places[..., 1] - 0.5, places[..., 0] - 0.5]).astype(np.float32)
        inside = np.isfinite(self._places).all(axis=0)
        inside &= (places[..., 0] >= 0) & (places[..., 0] <= lens.width)
        inside &= (places[..., 1] >= 0) & (places[..., 1] <= lens.height)
        if not inside.any():
            raise InputError(lens.source, f"distortion {lens.model} {lens.params} leaves no pixel of the image",
                             "correct the distortion parameters")  # fmt: skip
        self._places[:, ~inside] = 0
        self.outside = None if inside.all() else ~inside

    def camera(self, world_to_camera: np.ndarray) -> Camera:
        return Camera(*self.intrinsics, world_to_camera)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """[H, W] or [H, W, C] float32 -> the pinhole camera's image; 0 where the lens saw nothing."""
        from scipy.ndimage import map_coordinates

        planes = [image] if image.ndim == 2 else [image[..., c] for c in range(image.shape[2])]
        done = [map_coordinates(plane, self._places, order=1, mode="nearest", output=np.float32) for plane in planes]
        if self.outside is not None:
            for plane in done:
                plane[self.outside] = 0.0
        return done[0] if image.ndim == 2 else np.stack(done, axis=2)
