"""Pixels that pairs of photos share, by SIFT features, and their distance from the epipolar lines of two poses."""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from PIL import Image

from ..errors import InputError
from .dataparser import ImageRecord
from .images.ldr_files import PILLOW_ERRORS, open_image, orientation_of, turn_of_loaded, turn_upright
from .lens import Lens
from .masks import read_mask
from .photos import fitted_lens
from .sfm.reconstruction import quiet_colmap

SIDE = 640  # Pixels of the longest side that are compared
_MOST_FEATURES = 2000
_FEWEST_MATCHES, _RATIO = 30, 0.75  # Of a pair; a match's distance as part of that of the second best
_MOST_PAIRS = 12
_LEAST_BASELINE = 0.02  # Of the usual distance of cameras from their middle: nearer ones show no depth
_MASKED = 0.5  # Value of a mask up to which pixels do not count
_IN_FRONT = 0.2  # Part of the points that two cameras of the right direction see in front of them, at least


class SharedPixels(NamedTuple):
    """Pixels that two photos share."""

    indices: tuple[int, int]  # Of the two photos
    lenses: tuple[Lens, Lens]  # Of the two photos, at the sizes that are compared
    places: tuple[np.ndarray, np.ndarray]  # [k, 2] pixels in each photo

    def distance(self, lenses: Sequence[Lens], first: np.ndarray, second: np.ndarray) -> float:
        """Return the median distance of the pixels (Sampson's) from the epipolar lines of two world-to-camera poses.

        It is infinite if nearly all points would lie behind a camera.
        """
        rays = [_rays(lens, places) for lens, places in zip(lenses, self.places, strict=True)]
        return _epipolar_distance(rays[0], rays[1], lenses[0].focal[0], first, second)


def candidate_pairs(records: Sequence[ImageRecord]) -> list[tuple[int, int]]:
    """List pairs of photos that may share pixels: by turns neighbors in the set, and cameras that are near each other.

    Poses that are wrong may not be near each other, and photos of random names are no neighbors. Photos from one place,
    such as those of a bracket, fit whatever their poses are.
    """
    count = len(records)
    poses = np.stack([record.world_to_camera for record in records])
    centers = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    usual = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))) or 1.0
    pairs: dict[tuple[int, int], None] = {}
    for i in range(0, count - 1, max(1, (count - 1) // (_MOST_PAIRS // 2))):
        apart = np.linalg.norm(centers - centers[i], axis=1) / usual
        others = np.flatnonzero(apart > _LEAST_BASELINE)
        turned = 1 - poses[others, 2, :3] @ poses[i, 2, :3]
        following = others[others > i][:1]
        for other in (*following, *others[np.argsort(apart[others] + turned)[:1]]):
            pairs[min(i, int(other)), max(i, int(other))] = None
    return list(pairs)[:_MOST_PAIRS]


def shared_pixels(records: Sequence[ImageRecord], pairs: Sequence[tuple[int, int]]) -> Iterator[SharedPixels]:
    """Yield the pixels that pairs of photos share, one pair at a time; pairs that share too little are left out.

    Raises:
        ImportError: if pycolmap is not installed.
    """
    with quiet_colmap():
        from pycolmap import Bitmap, Device, FeatureExtractionOptions, FeatureExtractor

        options = FeatureExtractionOptions()
        options.sift.max_num_features, options.sift.first_octave = _MOST_FEATURES, 0  # The photo is not enlarged.
        extractor = FeatureExtractor.create(options, Device.cpu)

    @cache
    def features(index: int) -> tuple[Lens, np.ndarray, np.ndarray] | None:
        if (small := _small_photo(records[index])) is None:
            return None
        lens, grey, mask = small
        points, descriptors = extractor.extract(Bitmap.from_array(grey))
        places = np.array([(point.x, point.y) for point in points]).reshape(-1, 2)
        lengths = np.linalg.norm(descriptors.data.astype(np.float32), axis=1, keepdims=True)
        rows, columns = (np.clip(places[:, k].astype(int), 0, grey.shape[1 - k] - 1) for k in (1, 0))
        used = mask[rows, columns]
        return lens, places[used], (descriptors.data / lengths.clip(1e-6))[used]

    for i, j in pairs:
        if (first := features(i)) is not None and (second := features(j)) is not None:
            ours, theirs = _matches(first[2], second[2])
            if len(ours) >= _FEWEST_MATCHES:
                yield SharedPixels((i, j), (first[0], second[0]), (first[1][ours], second[1][theirs]))


def _small_photo(record: ImageRecord) -> tuple[Lens, np.ndarray, np.ndarray] | None:
    """Return the lens of a reduced photo, its grey codes and its mask [H, W]; None for one that cannot serve."""
    if record.lens.projection != "pinhole":
        return None
    try:
        lens, oriented = fitted_lens(record)
        scale = min(1.0, SIDE / max(lens.width, lens.height))
        lens = lens.resized(max(1, round(lens.width * scale)), max(1, round(lens.height * scale)))
        with open_image(record.image) as image:
            if image.mode not in ("L", "RGB", "RGBA", "P"):
                return None
            file_orientation = orientation_of(image)
            turned = oriented and file_orientation in (5, 6, 7, 8)
            image.draft("L", (lens.height, lens.width) if turned else (lens.width, lens.height))
            grey = image.convert("RGB").convert("L")
            turn = turn_of_loaded(image, file_orientation, oriented=oriented)
            size = (lens.height, lens.width) if turn in (5, 6, 7, 8) else (lens.width, lens.height)
            grey = grey.resize(size, Image.Resampling.BOX)
        mask = np.ones((lens.height, lens.width), bool)
        if record.mask is not None:
            stored = Image.fromarray(read_mask(record.mask, oriented=oriented))
            mask = np.asarray(stored.resize((lens.width, lens.height), Image.Resampling.BOX)) > _MASKED
        return lens, turn_upright(np.asarray(grey), turn), mask
    except (InputError, *PILLOW_ERRORS):
        return None


def _matches(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices [k] of descriptors of unit length, [m, 128] and [n, 128], that are clearly each other's."""
    if min(len(first), len(second)) < _FEWEST_MATCHES:
        return np.zeros(0, int), np.zeros(0, int)
    distances = np.sqrt(np.clip(2 - 2 * first @ second.T, 0, None))
    nearest = distances.argmin(1)
    best, second_best = np.partition(distances, 1, axis=1)[:, :2].T
    ours = np.flatnonzero((best < _RATIO * second_best) & (distances.argmin(0)[nearest] == np.arange(len(first))))
    return ours, nearest[ours]


def _rays(lens: Lens, places: np.ndarray) -> np.ndarray:
    """Return the rays [k, 3] (x right, y down, z = 1) of pixels [k, 2]."""
    import pycolmap

    camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    flat = np.asarray(camera.cam_from_img(places), np.float64)
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)


def _epipolar_distance(
    ours: np.ndarray, theirs: np.ndarray, focal: float, first: np.ndarray, second: np.ndarray
) -> float:
    between = second @ np.linalg.inv(first)
    x, y, z = between[:3, 3] / max(float(np.linalg.norm(between[:3, 3])), 1e-300)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ between[:3, :3]
    lines, other_lines = ours @ essential.T, theirs @ essential
    slopes = (lines[:, :2] ** 2).sum(1) + (other_lines[:, :2] ** 2).sum(1)
    distances = focal * np.abs((theirs * lines).sum(1)) / np.sqrt(np.maximum(slopes, 1e-300))
    turned = ours @ between[:3, :3].T
    across = np.cross(turned, theirs)
    # Signs of the depths in the first and the second camera at which the rays meet
    depths = (np.cross(theirs, (x, y, z)) * across).sum(1), (np.cross(turned, (x, y, z)) * across).sum(1)
    in_front = np.mean((depths[0] > 0) & (depths[1] > 0))
    # A lens model may not hold in the corners, whose rays are NaN then.
    return float(np.nanmedian(distances)) if in_front >= _IN_FRONT else np.inf
