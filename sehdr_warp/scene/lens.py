"""Cameras as photographed, with lens distortion, and the pinhole cameras that their photos are resampled to."""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
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

    Projections and the choice of the pinhole camera (size and focal length, no blank border) are COLMAP's; resampling
    is bilinear, on float images. Raises InputError where the lens cannot be undone.
    """

    def __init__(self, lens: Lens):
        try:
            distort, (width, height, fx, fy, cx, cy) = _projection(lens)
            if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE and np.isfinite([fx, fy, cx, cy]).all()):
                raise ValueError(f"size {width} x {height}, focal length {fx}")
            columns, rows = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
            places = distort(np.stack(np.meshgrid(columns, rows), axis=2).reshape(-1, 2)).reshape(height, width, 2)
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


_RADIAL = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8}
_FISHEYE = {"SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2, "OPENCV_FISHEYE": 4, "SIMPLE_FISHEYE": 0, "FISHEYE": 0}


def _projection(lens: Lens):
    """A function from normalised coordinates [N, 2] to the lens's pixels, and the pinhole camera's intrinsics.

    Common lenses are projected here; pycolmap, which takes a second to load, knows the others.
    """
    if lens.model in _RADIAL or lens.model in _FISHEYE:
        distort = functools.partial(_pixels, lens)
        return distort, _pinhole_without_border(lens, distort)
    import pycolmap

    camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    intrinsics = (target.focal_length_x, target.focal_length_y, target.principal_point_x, target.principal_point_y)

    def distort(points: np.ndarray) -> np.ndarray:
        return np.asarray(camera.img_from_cam(np.concatenate([points, np.ones((len(points), 1))], axis=1)))

    return distort, (int(target.width), int(target.height), *intrinsics)


def _pixels(lens: Lens, points: np.ndarray) -> np.ndarray:
    """Normalised coordinates [N, 2] -> pixels [N, 2] (COLMAP, src/colmap/sensor/models.h)."""
    (x, y), k = points.T, lens.params[3 if lens.model in _ONE_FOCAL else 4 :]
    with np.errstate(all="ignore"):
        if lens.model in _FISHEYE:
            radius = np.hypot(x, y)
            angle = np.arctan(radius)
            bent = angle * (1 + sum(value * angle ** (2 * i + 2) for i, value in enumerate(k)))
            scale = np.where(radius > 1e-12, bent / np.maximum(radius, 1e-12), 1.0)
            u, v = x * scale, y * scale
        else:
            k1, k2, p1, p2, k3, k4, k5, k6 = (*k, *[0.0] * (8 - len(k)))
            r = x * x + y * y
            scale = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)))
            u = x * scale + 2 * p1 * x * y + p2 * (r + 2 * x * x)
            v = y * scale + 2 * p2 * x * y + p1 * (r + 2 * y * y)
    (fx, fy), (cx, cy) = lens.focal, lens.centre
    return np.stack([fx * u + cx, fy * v + cy], axis=1)


def _pinhole_without_border(lens: Lens, distort) -> tuple[int, int, float, float, float, float]:
    """The size and intrinsics that COLMAP's undistort_camera takes: the largest picture without a blank pixel."""
    (fx, fy), (cx, cy), width, height = lens.focal, lens.centre, lens.width, lens.height
    rows, columns = np.arange(height) + 0.5, np.arange(width) + 0.5

    def edge(fixed: float, axis: int) -> np.ndarray:
        """Where a border of the photo lies in the pinhole at the photo's focal lengths, along `axis`."""
        along = rows if axis == 0 else columns
        pixels = np.stack([np.full(len(along), fixed), along][:: 1 if axis == 0 else -1], axis=1)
        places = _normalised(lens, distort, pixels)[:, axis] * (fx, fy)[axis] + (cx, cy)[axis]
        places = places[np.isfinite(places)]
        if not len(places):
            raise ValueError("no border pixel has a ray")
        return places

    left, right, top, bottom = edge(0.5, 0), edge(width - 0.5, 0), edge(0.5, 1), edge(height - 0.5, 1)
    with np.errstate(all="ignore"):
        across = 1 / max(cx / (cx - left.max()), (width - 0.5 - cx) / (right.min() - cx))
        down = 1 / max(cy / (cy - top.max()), (height - 0.5 - cy) / (bottom.min() - cy))
    across, down = (float(np.clip(scale, 0.2, 2.0)) for scale in (across, down))
    new = max(1, int(across * width)), max(1, int(down * height))
    return *new, fx, fy, cx * new[0] / width, cy * new[1] / height


def _normalised(lens: Lens, distort, pixels: np.ndarray) -> np.ndarray:
    """[N, 2] normalised coordinates of pixels by Newton's method; NaN where it finds none."""
    start = (pixels - lens.centre) / lens.focal
    points, step = start.copy(), 1e-6
    with np.errstate(all="ignore"):
        for _ in range(100):
            off = (distort(points) - pixels) / lens.focal
            if not np.abs(off[np.isfinite(off).all(1)]).max(initial=0.0) > 1e-12:
                break
            columns = [(distort(points + shift) - distort(points - shift)) / lens.focal / (2 * step)
                       for shift in np.eye(2) * step]  # fmt: skip
            (a, c), (b, d) = (column.T for column in columns)
            u, v = off.T / (a * d - b * c)
            points -= np.stack([d * u - b * v, a * v - c * u], axis=1)
        off = np.abs(distort(points) - pixels).max(axis=1)
    points[~(off < 1e-4)] = np.nan
    return points
