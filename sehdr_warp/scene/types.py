"""Views, and the scene that they form."""

from collections import Counter
from dataclasses import dataclass
from math import inf
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .camera import Camera

if TYPE_CHECKING:
    from ..response import Response
    from .lens import Lens

SPLITS = "train", "test"


@dataclass(frozen=True, repr=False)
class View:
    """One photo with its camera, which is undistorted if it is a pinhole.

    Attributes:
        name: the image's stem in the data (`r_0`); unique within a scene.
        codes: [H, W, 3] uint8 as stored in the photo, or uint16 if the photo has 16 bits, was averaged or converted to
            other primaries; at the camera's size.
        camera: its undistorted camera.
        exposure_time: seconds, positive.
        split: "train" or "test".
        mask: [H, W] float32 in [0, 1], 1 keeps the pixel; None keeps all.
        hdr: [H, W, 3] float32 scene-linear truth (radiance, not multiplied by the exposure time); None without truth.
        source: the file the photo came from.
        light_above_white: [H, W, 3] float16, the light of clipped pixels that the photo's file states beside its codes
            (by a gain map, for example), as a multiple of the exposure that the code of white stands for; at least 1
            where it is known, 0 elsewhere. None if the file states none.
        light_above_white_deviation: standard deviation of the natural logarithm of light_above_white.
        lens: of the photo, before it was undistorted; None for a view built in code.
        orientation: EXIF's, by which the pixels would have to be turned to stand upright; 1 if they do.
        uncertain: whether structure from motion placed the camera by few points.

    Raises:
        TypeError: for a name, camera, exposure time or source of another type.
        ValueError: for an array of another type or size than stated here, and for another split, exposure time or
            orientation. Pixels are not read; codes_of returns codes for encoded values.
    """

    name: str
    codes: np.ndarray
    camera: Camera
    exposure_time: float
    split: str
    mask: np.ndarray | None = None
    hdr: np.ndarray | None = None
    source: Path | None = None
    light_above_white: np.ndarray | None = None
    light_above_white_deviation: float = 0.0
    lens: "Lens | None" = None
    orientation: int = 1
    uncertain: bool = False

    def __post_init__(self):
        """Check types, shapes and ranges; pixels are not read."""
        if not isinstance(self.name, str):
            raise TypeError(f"name of a view is {self.name!r:.60}, expected text")
        codes, camera = self.codes, self.camera
        if getattr(codes, "dtype", None) not in (np.uint8, np.uint16) or codes.ndim != 3 or codes.shape[2] != 3:
            raise ValueError(f"{self._field('codes')}, not NumPy's uint8 or uint16 [H, W, 3]; see codes_of")
        if not isinstance(camera, Camera):
            raise TypeError(f"{self._field('camera')}, expected a Camera")
        if codes.shape[:2] != (camera.height, camera.width):
            size = f"its codes {codes.shape[1]} x {codes.shape[0]}; see Camera.resized"
            raise ValueError(f"camera of view {self.name} is of {camera.width} x {camera.height} pixels, {size}")
        if not isinstance(self.exposure_time, Real):
            raise TypeError(f"{self._field('exposure_time')}, expected a number of seconds")
        if not 0 < self.exposure_time < inf:
            raise ValueError(f"{self._field('exposure_time')}, expected seconds above 0; without known times, give 1")
        if self.split not in SPLITS:
            raise ValueError(f"{self._field('split')}, expected 'train' or 'test'")
        for name, kind, shape in (
            ("mask", np.float32, codes.shape[:2]),
            ("hdr", np.float32, codes.shape),
            ("light_above_white", np.float16, codes.shape),
        ):
            array = getattr(self, name)
            if array is not None and not (
                isinstance(array, np.ndarray) and (array.dtype, array.shape) == (kind, shape)
            ):
                expected = f"a NumPy array {np.dtype(kind)} {list(shape)}, as its codes have pixels"
                raise ValueError(f"{self._field(name)}, expected {expected}")
        if self.source is not None and not isinstance(self.source, Path):
            raise TypeError(f"{self._field('source')}, expected a pathlib.Path")
        if self.orientation not in range(1, 9):
            raise ValueError(f"{self._field('orientation')}, expected EXIF's, 1 to 8")

    def _field(self, name: str) -> str:
        """Return what messages say of a field: its name, the view and its value."""
        return f"{name} of view {self.name} is {_description_of(getattr(self, name))}"

    def __repr__(self) -> str:
        """Return name, size, split and exposure time in one line."""
        height, width = self.codes.shape[:2]
        return f"View({self.name!r}, {width} x {height}, {self.split}, {self.exposure_time:.3g} s)"

    @property
    def levels(self) -> int:
        """The code of white: 255 or 65535."""
        return int(np.iinfo(self.codes.dtype).max)

    @property
    def image(self) -> np.ndarray:
        """The encoded values [H, W, 3] float32 in [0, 1], computed at each access."""
        return encoded_values(self.codes)


@dataclass(frozen=True, repr=False)
class Scene:
    """A set of posed views and the sparse points seen in them.

    Attributes:
        name: of the set.
        format: the layout of the data (colmap, transforms, opensfm, meshroom, arkit, hdr-nerf, hdr-nerf-real, hdr-gs,
            llff, photos, video).
        views: in the order of their names.
        points: [P, 3] float64 world coordinates, P may be 0.
        point_colors: [P, 3] float32 in [0, 1], encoded like photos.
        exposure_times_known: False if no file states them; then each view has 1 second.
        notes: lines for the user (differing exposures, views left out, ...).
        response: the curve by which the photos were averaged; None for a scene built in code.
        chosen_by: the method and the candidates that selected the response; None if the user named it.
        light_known: True if this package encoded the codes from known light by `response`: RAW, linear and float
            photos, and those whose files state their transfer function.
        photos_normalized: True if the photos were normalized; see ExposureCompensation.normalize_photos.
        color_matrix: [3, 3] from the primaries of the codes' light to linear Rec.709; None if these are Rec.709.
        unplaced: number of photos without a camera, which are in no view.
        black_background: True if photos have transparent parts that count as black light, as those of rendered sets do.

    Raises:
        TypeError: for views that are no tuple or list of Views.
        ValueError: for two views of one name, points or colors of another shape or that are not finite, and a color
            matrix of another shape.
    """

    name: str
    format: str
    views: tuple[View, ...]
    points: np.ndarray
    point_colors: np.ndarray
    exposure_times_known: bool = True
    notes: tuple[str, ...] = ()
    response: "Response | None" = None
    chosen_by: tuple[str, tuple[str, ...]] | None = None
    color_matrix: np.ndarray | None = None
    light_known: bool = False
    photos_normalized: bool = False
    unplaced: int = 0
    black_background: bool = False

    def __post_init__(self):
        """Check the types and shapes, and make a tuple of a list of views."""
        if not isinstance(self.views, tuple | list):
            raise TypeError(f"views of scene {self.name} is {_description_of(self.views)}, expected a tuple of Views")
        for view in self.views:
            if not isinstance(view, View):
                raise TypeError(f"views of scene {self.name} has {_description_of(view)}, expected Views")
        object.__setattr__(self, "views", tuple(self.views))
        name, count = next(iter(Counter(view.name for view in self.views).most_common(1)), ("", 0))
        if count > 1:
            raise ValueError(f"views of scene {self.name} has {count} views named {name!r}; give each its own name")
        points, colors = self.points, self.point_colors
        for field, array in (("points", points), ("point_colors", colors)):
            if not isinstance(array, np.ndarray) or array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind != "f":
                problem = f"{field} of scene {self.name} is {_description_of(array)}"
                raise ValueError(f"{problem}, expected floats [P, 3]; P may be 0")
        if len(points) != len(colors):
            counts = f"{len(colors)} point_colors for {len(points)} points"
            raise ValueError(f"scene {self.name} has {counts}; give each point a color")
        if not (finite := np.isfinite(points).all(1)).all():
            row = int(np.argmin(finite))
            raise ValueError(f"point {row} of scene {self.name} is {points[row].tolist()}; leave it and its color out")
        if not (colors.min(initial=0) >= 0 and colors.max(initial=1) <= 1):
            limits = f"{colors.min():g} to {colors.max():g}"
            raise ValueError(f"point_colors of scene {self.name} are {limits}, not in [0, 1]; divide codes by 255")
        if self.color_matrix is not None and np.shape(self.color_matrix) != (3, 3):
            matrix = _description_of(self.color_matrix)
            raise ValueError(f"color_matrix of scene {self.name} is {matrix}, expected [3, 3]")

    def __repr__(self) -> str:
        """Return name, format, number of views and their size in one line."""
        sizes = sorted({view.codes.shape[1::-1] for view in self.views})
        size = "" if not sizes else f" of {sizes[-1][0]} x {sizes[-1][1]}" + (" at most" if len(sizes) > 1 else "")
        return f"Scene({self.name!r}, {self.format}, {len(self.views)} views{size}, {len(self.train_views)} to train)"

    @property
    def train_views(self) -> tuple[View, ...]:
        """The views to train on."""
        return tuple(view for view in self.views if view.split == "train")

    @property
    def test_views(self) -> tuple[View, ...]:
        """The views held out for testing."""
        return tuple(view for view in self.views if view.split == "test")


def _description_of(value: Any) -> str:
    """Return what messages call a value: type and shape of an array, else the value in up to 60 characters."""
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return f"{value.dtype} {list(value.shape)}"
    return f"a {type(value).__name__} of {len(value)}" if isinstance(value, tuple | list) else f"{value!r:.60}"


def encoded_values(codes: np.ndarray) -> np.ndarray:
    """Return float32 values in [0, 1] of uint8 or uint16 codes."""
    return codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)


def codes_of(image: np.ndarray, bits: int | None = None) -> np.ndarray:
    """Return the rounded codes of encoded values, which are clipped to [0, 1].

    Args:
        image: any shape.
        bits: 8 or 16; None takes 8 if these hold the values exactly, else 16.
    """
    image = np.clip(image, 0.0, 1.0)
    if bits != 16:
        small = np.rint(image * 255)
        if bits == 8 or np.abs(image * 255 - small).max(initial=0.0) < 1e-3:
            return small.astype(np.uint8)
    return np.rint(image * 65535).astype(np.uint16)
