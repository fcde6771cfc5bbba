"""Check of stated poses against the photos: pixels that two photos share must fit their cameras.

transforms.json has OpenGL's axes by convention, but scripts also write OpenCV's, or world-to-camera matrices. Nothing
in the file tells them apart, and a training on wrong poses fails without an error.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from PIL import Image

from ..errors import InputError
from .dataparser import ImageRecord
from .images.ldr_files import PILLOW_ERRORS, open_image
from .lens import Lens, Undistortion
from .sfm.reconstruction import quiet_colmap

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # Between the axes of OpenGL (y up, z back) and OpenCV (y down, z ahead)
_READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as camera-to-world in OpenCV's axes": lambda pose: _FLIP @ pose,
    "as world-to-camera in OpenCV's axes": lambda pose: np.linalg.inv(pose) @ _FLIP,
    "as world-to-camera in OpenGL's axes": lambda pose: _FLIP @ np.linalg.inv(pose) @ _FLIP,
}
"""World-to-camera matrices, by what the file holds, of one that was read as camera-to-world in OpenGL's axes."""
_SIDE = 800  # Pixels of the longest side that are compared
_MOST_PAIRS, _FEWEST_PAIRS, _SURE_PAIRS = 8, 4, 3  # That are compared, that show poses to be wrong, and right
_FEWEST_MATCHES, _RATIO = 30, 0.75  # Of a pair; a match's distance as part of that of the second best
_FITS, _MISSES = 1.5, 6.0  # Pixels: sound poses have 0.1 to 0.6, other axes 3 to 130
_LEAST_SHARE = 0.75  # Of the pairs, which another reading must fit


def with_fitting_poses(records: Sequence[ImageRecord]) -> tuple[list[ImageRecord], list[str]]:
    """Return photos with poses by the reading that fits neighboring photos, and a note if it is not OpenGL's.

    Few photos are read: three pairs that fit end the check.
    """
    try:
        with quiet_colmap():
            from pycolmap import Bitmap, Device, FeatureExtractionOptions, FeatureExtractor

            options = FeatureExtractionOptions()
            options.sift.max_num_features, options.sift.first_octave = 2000, 0  # A photo is not enlarged to find more.
            extractor = FeatureExtractor.create(options, Device.cpu)
    except ImportError:
        return list(records), ["poses: not compared with the photos, because pycolmap is not installed"]
    undistortion = cache(Undistortion)

    def extract(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points, descriptors = extractor.extract(Bitmap.from_array(grey))
        return np.array([(point.x, point.y) for point in points]).reshape(-1, 2), descriptors.data

    @cache
    def features(index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        return _features(records[index], extract, undistortion)

    stated: list[float] = []
    others: dict[str, list[float]] = {reading: [] for reading in _READINGS}
    for i in range(0, len(records) - 1, max(1, (len(records) - 1) // _MOST_PAIRS)):
        first, second = features(i), features(i + 1)
        if first is None or second is None or (places := _matches(first, second)) is None:
            continue
        poses = records[i].world_to_camera, records[i + 1].world_to_camera
        stated.append(_distance(places, *poses))
        for reading, read in _READINGS.items():
            others[reading].append(_distance(places, read(poses[0]), read(poses[1])))
        if sum(distance < _FITS for distance in stated) >= _SURE_PAIRS:
            return list(records), []
    if len(stated) < _FEWEST_PAIRS or np.median(stated) < _MISSES:
        return list(records), []
    best = min(others, key=lambda reading: float(np.median(others[reading])))
    miss = f"pixels that two photos share lie {np.median(stated):.0f} pixels beside where they must be"
    if np.mean(np.array(others[best]) < _FITS) < _LEAST_SHARE:
        remedy = "to find the cameras anew, give a folder with the photos alone"
        return list(records), [f"poses: they do not fit the photos, by no convention: {miss}; {remedy}"]
    fitting = [replace(record, world_to_camera=_READINGS[best](record.world_to_camera)) for record in records]
    fit = f"which fits the photos ({np.median(others[best]):.1f} pixels)"
    return fitting, [f"poses: {miss} by the convention of transforms.json; they are read {best} instead, {fit}"]


def _features(
    record: ImageRecord,
    extract: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    undistortion: Callable[[Lens], Undistortion],
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return rays [m, 3] and descriptors [m, 128] of a photo, and pixels per unit; None for one that cannot serve."""
    lens = record.lens
    if lens.projection != "pinhole":
        return None
    scale = min(1.0, _SIDE / max(lens.width, lens.height))
    size = max(1, round(lens.width * scale)), max(1, round(lens.height * scale))
    try:
        with open_image(record.image) as image:
            if image.mode not in ("L", "RGB", "RGBA", "P") or (image.width > image.height) != (size[0] > size[1]):
                return None
            image.draft("L", size)
            grey = np.asarray(image.convert("RGB").convert("L").resize(size, Image.Resampling.BOX))
        unbent = undistortion(lens.resized(*size))
        grey = np.rint(unbent.apply(np.repeat(grey[..., None], 3, -1).astype(np.float32)))[..., 0]
    except (InputError, *PILLOW_ERRORS):
        return None
    places, descriptors = extract(np.ascontiguousarray(np.clip(grey, 0, 255).astype(np.uint8)))
    camera = unbent.camera(record.world_to_camera)
    x, y = (places[:, 0] - camera.cx) / camera.fx, (places[:, 1] - camera.cy) / camera.fy
    rays = np.stack([x, y, np.ones_like(x)], -1).astype(np.float64)
    descriptors = descriptors.astype(np.float32)
    return rays, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True).clip(1e-6), np.array(camera.fx)


def _matches(
    first: tuple[np.ndarray, np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return the rays [k, 3] in both photos of what they share, and pixels per unit; None if it is too little."""
    if min(len(first[0]), len(second[0])) < _FEWEST_MATCHES:
        return None
    distances = np.sqrt(np.clip(2 - 2 * first[1] @ second[1].T, 0, None))
    nearest = distances.argpartition(1, axis=1)[:, :2]
    pair = np.take_along_axis(distances, nearest, 1)
    nearest = np.take_along_axis(nearest, pair.argsort(1), 1)
    pair.sort(1)
    clear = (pair[:, 0] < _RATIO * pair[:, 1]) & (distances.argmin(0)[nearest[:, 0]] == np.arange(len(distances)))
    if clear.sum() < _FEWEST_MATCHES:
        return None
    return first[0][clear], second[0][nearest[clear, 0]], float(first[2])


def _distance(places: tuple[np.ndarray, np.ndarray, float], first: np.ndarray, second: np.ndarray) -> float:
    """Return the median distance in pixels (Sampson's) of shared pixels from the epipolar lines of two poses."""
    rays, other_rays, focal = places
    between = second @ np.linalg.inv(first)
    x, y, z = between[:3, 3] / max(float(np.linalg.norm(between[:3, 3])), 1e-300)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ between[:3, :3]
    lines, other_lines = rays @ essential.T, other_rays @ essential
    slopes = (lines[:, :2] ** 2).sum(1) + (other_lines[:, :2] ** 2).sum(1)
    return float(np.median(focal * np.abs((other_rays * lines).sum(1)) / np.sqrt(np.maximum(slopes, 1e-300))))
