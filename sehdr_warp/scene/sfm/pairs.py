"""Pairs of photos that are likely to show the same things, by their coarsest features (as Wu, 3DV 2013, orders pairs).

Matching all features of all pairs takes most of the time of structure from motion, and most pairs share nothing.
"""

import itertools
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...progress import track_progress

_log = logging.getLogger("sehdr_warp.scene")
FEATURES = 512  # The largest ones of each photo, of 4,000 to 10,000
PARTNERS = 12  # Photos that each one is matched with at least, unless they share nothing at all
MOST_GUIDED = 1000  # Pairs of unplaced photos, along epipolar lines: 2 to 4 times the points, 2.7 times the time
_SURE, _MOST_TURNED = 60, 0.8  # Matches of a sure pair; part of such pairs that a turn explains: 0.8 to 1, else to 0.3
_NEAR = 0.5  # Extent of cameras over their distance from the points; 0.2 to 0.4 of cameras that only turned
RATIO = 0.8  # Largest ratio of the angles to the best and to the second best match, as COLMAP has it


def likely_pairs(database: Path) -> list[tuple[str, str]]:
    """Return pairs of image names of COLMAP's database: for each image the PARTNERS images that match it best."""
    names, features = _coarse_features(database)
    scores = np.zeros((len(names), len(names)), int)
    for _, i in track_progress("comparing photos", range(len(names)), _log):
        for j in range(i + 1, len(names)):
            scores[i, j] = scores[j, i] = match_count(features[i], features[j])
    best = np.argsort(-scores, axis=1, kind="stable")[:, :PARTNERS]
    pairs = {(min(i, j), max(i, j)) for i, row in enumerate(best.tolist()) for j in row if scores[i, j]}
    return [(names[i], names[j]) for i, j in sorted(pairs)]


def pairs_with(names: set[str], database: Path) -> list[tuple[str, str]]:
    """Return the pairs of image names of COLMAP's database of which one image is among the given ones."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        images = sorted(image.name for image in opened.read_all_images())
    return [pair for pair in itertools.combinations(images, 2) if names.intersection(pair)]


def remove_matches(pairs: Sequence[tuple[str, str]], database: Path) -> None:
    """Remove the matches between pairs of images by their names, because COLMAP passes over pairs that have some."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        for first, second in pairs:
            if opened.exists_matches(numbers[first], numbers[second]):
                opened.delete_matches(numbers[first], numbers[second])
            if opened.exists_two_view_geometry(numbers[first], numbers[second]):
                opened.delete_two_view_geometry(numbers[first], numbers[second])


def _coarse_features(database: Path) -> tuple[list[str], list[np.ndarray]]:
    """Return image names, sorted, and the unit descriptors [K, 128] float32 of each one's largest features."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        features = []
        for image in images:
            a, b, c, d = np.asarray(opened.read_keypoints(image.image_id))[:, 2:6].T  # Columns of the affine shape
            largest = np.argsort(-np.abs(a * d - b * c), kind="stable")[:FEATURES]
            values = np.asarray(opened.read_descriptors(image.image_id).data)[largest].astype(np.float32)
            features.append(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12))
    return [image.name for image in images], features


def match_count(first: np.ndarray, second: np.ndarray) -> int:
    """Return how many unit vectors [K, D] of two sets are each other's nearest, and nearer than the second nearest."""
    if min(len(first), len(second)) < 2:
        return 0
    cosines = first @ second.T
    nearest, back = cosines.argmax(1), cosines.argmax(0)
    mutual = np.flatnonzero(back[nearest] == np.arange(len(first)))
    rows, partners = cosines[mutual], nearest[mutual, None]
    best = np.take_along_axis(rows, partners, 1)[:, 0]
    np.put_along_axis(rows, partners, -1.0, 1)
    angle, next_angle = (np.arccos(np.clip(cosine, -1, 1)) for cosine in (best, rows.max(1, initial=-1.0)))
    return int((angle < RATIO * next_angle).sum())


def from_one_place(database: Path, model: Any = None) -> bool:
    """Return whether a camera that only turned on the spot explains most pairs of matched photos.

    A flat scene has such pairs, too: the cameras of a `model`, a pycolmap.Reconstruction, must also be nearer to each
    other than to its points.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        geometries = opened.read_two_view_geometries()[1]
    turned = int(pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC)
    sure = [geometry.config == turned for geometry in geometries if len(geometry.inlier_matches) >= _SURE]
    if not sure or np.mean(sure) < _MOST_TURNED:
        return False
    if model is None:
        return True
    places = np.array([model.images[i].projection_center() for i in model.reg_image_ids()])
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    center = places.mean(axis=0)
    spread, distance = (np.linalg.norm(each - center, axis=1) for each in (places, points))
    return len(points) > 0 and bool(2 * spread.max() < _NEAR * np.median(distance))
