"""Views, and the scene that they form."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .camera import Camera

if TYPE_CHECKING:
    from ..response import Response
    from .lens import Lens


@dataclass(frozen=True, repr=False)
class View:
    """One photo with its undistorted pinhole camera.

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
        ValueError: if codes have another type or shape; codes_of returns codes for encoded values.
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
        """Check the types and shapes."""
        codes = self.codes
        if getattr(codes, "dtype", None) not in (np.uint8, np.uint16) or codes.ndim != 3 or codes.shape[2] != 3:
            problem = f"{getattr(codes, 'dtype', type(codes).__name__)} {list(getattr(codes, 'shape', ()))}"
            raise ValueError(f"codes of view {self.name} are {problem}, not uint8 or uint16 [H, W, 3]; see codes_of")
        if self.light_above_white is not None and self.light_above_white.shape != codes.shape:
            problem = list(self.light_above_white.shape)
            raise ValueError(f"light_above_white of view {self.name} is {problem}, its codes are {list(codes.shape)}")

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
