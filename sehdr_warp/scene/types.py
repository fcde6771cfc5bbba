"""What was photographed: views, the scene they form, and what the user should know about it."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .camera import Camera

if TYPE_CHECKING:
    from ..response import Response


@dataclass(frozen=True)
class View:
    """One photo with its undistorted pinhole camera.

    Attributes:
        name: the image's stem in the data (`r_0`); unique within a scene.
        codes: [H, W, 3] uint8 as photographed, or uint16 where the photo has 16 bits or was averaged; at the camera's
            size.
        camera: where it was taken from.
        exposure_time: seconds, positive.
        split: "train" or "test".
        mask: [H, W] float32 in [0, 1], 1 where the pixel counts; None means all count.
        hdr: [H, W, 3] float32 scene-linear truth (radiance, not multiplied by the exposure time); None without truth.
        source: the file the photo came from.
        light_above_white: [H, W, 3] float16, the light of clipped pixels that the photo's file states beside its codes
            (by a gain map, for example), as a multiple of the exposure that the code of white stands for; at least 1
            where it is known, 0 elsewhere. None if the file states none.
        light_above_white_deviation: standard deviation of the natural logarithm of light_above_white.

    Raises:
        ValueError: for codes of another type or shape; codes_of makes them of encoded values.
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

    def __post_init__(self):
        codes = self.codes
        if getattr(codes, "dtype", None) not in (np.uint8, np.uint16) or codes.ndim != 3 or codes.shape[2] != 3:
            found = f"{getattr(codes, 'dtype', type(codes).__name__)} {list(getattr(codes, 'shape', ()))}"
            raise ValueError(f"codes of view {self.name} are {found}, not uint8 or uint16 [H, W, 3]; see codes_of")
        if self.light_above_white is not None and self.light_above_white.shape != codes.shape:
            found = list(self.light_above_white.shape)
            raise ValueError(f"light_above_white of view {self.name} is {found}, its codes are {list(codes.shape)}")

    @property
    def levels(self) -> int:
        """The code of white: 255 or 65535."""
        return int(np.iinfo(self.codes.dtype).max)

    @property
    def image(self) -> np.ndarray:
        """[H, W, 3] float32 in [0, 1]: the encoded values, made anew at each call."""
        return encoded_values(self.codes)


@dataclass(frozen=True)
class Scene:
    """A set of posed views and the sparse points seen in them.

    Attributes:
        name: of the set.
        format: the layout that was read (colmap, transforms, hdr-nerf, hdr-nerf-real, hdr-gs, llff, photos).
        views: in the order of their names.
        points: [P, 3] float64 world coordinates, P may be 0.
        point_colors: [P, 3] float32 in [0, 1], encoded like photos.
        exposure_times_known: False where no file stated them (then each view's is 1 second).
        notes: one line each on what the user should know (differing exposures, views left out, ...).
        response: the curve the photos were averaged by; None for a scene made by hand.
        chosen_by: the method and the candidates that chose the response; None where it was named.
        light_known: the photos' codes were made of light by `response`, of no camera's choice: RAW, linear, float.
        evened: what the camera changed between photos unsaid is taken out of them; see photo_gains.
        color_matrix: [3, 3] from the colors of the codes' light to linear Rec.709; None where these are Rec.709
            themselves.
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
    evened: bool = False

    @property
    def train_views(self) -> tuple[View, ...]:
        return tuple(view for view in self.views if view.split == "train")

    @property
    def test_views(self) -> tuple[View, ...]:
        return tuple(view for view in self.views if view.split == "test")


def encoded_values(codes: np.ndarray) -> np.ndarray:
    """float32 in [0, 1] from uint8 or uint16 codes."""
    return codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)


def codes_of(image: np.ndarray, bits: int | None = None) -> np.ndarray:
    """Codes of encoded values in [0, 1], rounded: uint8 or uint16 by bits (8, 16), or by whether 8 bits hold them."""
    image = np.clip(image, 0.0, 1.0)
    if bits != 16:
        small = np.rint(image * 255)
        if bits == 8 or np.abs(image * 255 - small).max(initial=0.0) < 1e-3:
            return small.astype(np.uint8)
    return np.rint(image * 65535).astype(np.uint16)
