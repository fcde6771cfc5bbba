"""What was photographed: views, the scene they form, and what the user should know about it."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .camera import Camera


@dataclass(frozen=True)
class View:
    """One photo with its camera.

    name: the image's stem in the data (`r_0`); unique within a scene.
    image: [H, W, 3] float32 in [0, 1], encoded (LDR) values as photographed, at the camera's size.
    camera: the undistorted pinhole camera.
    exposure_time: seconds, positive.
    split: "train" or "test".
    mask: [H, W] float32 in [0, 1], 1 where the pixel counts; None means all count.
    hdr: [H, W, 3] float32 scene-linear truth (radiance, not multiplied by the exposure time); None without truth.
    source: the file the image came from.
    """

    name: str
    image: np.ndarray
    camera: Camera
    exposure_time: float
    split: str
    mask: np.ndarray | None = None
    hdr: np.ndarray | None = None
    source: Path | None = None


@dataclass(frozen=True)
class Scene:
    """A set of posed views and the sparse points seen in them.

    format: the layout that was read ("colmap", "transforms", "hdr-nerf", "hdr-nerf-real", "hdr-gs", "llff",
        "photos").
    points: [P, 3] float64 world coordinates, P may be 0.
    point_colors: [P, 3] float32 in [0, 1], encoded like the images.
    exposure_times_known: False where no file stated them (then each view's is 1 second).
    notes: one line each on what the user should know (differing exposures, views left out, ...).
    predictor: what predicted the `hdr` of the training views, each from its photo; None where `hdr` is truth.
    """

    name: str
    format: str
    views: tuple[View, ...]
    points: np.ndarray
    point_colors: np.ndarray
    exposure_times_known: bool = True
    notes: tuple[str, ...] = field(default=())
    predictor: str | None = None

    @property
    def train_views(self) -> tuple[View, ...]:
        return tuple(view for view in self.views if view.split == "train")

    @property
    def test_views(self) -> tuple[View, ...]:
        return tuple(view for view in self.views if view.split == "test")
