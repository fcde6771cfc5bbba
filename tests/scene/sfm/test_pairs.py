"""Choosing pairs of photos to match, and matching a photo that has no likely one."""

from pathlib import Path

import numpy as np
import pytest

from sehdr_warp.scene.sfm import pairs as sfm_pairs
from sehdr_warp.scene.sfm import reconstruction
from sehdr_warp.scene.sfm.pairs import from_one_place, likely_pairs, match_count, pairs_with


def descriptors(count, seed, like=None, noise=0.0):
    """Random unit vectors [count, 128], or those of `like` with noise, in another order."""
    random = np.random.default_rng(seed)
    values = np.abs(random.normal(size=(count, 128))) if like is None else random.permutation(like)
    values = values + noise * random.normal(size=values.shape) / np.sqrt(128)
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


def test_features_of_one_thing_match_and_others_do_not():
    first = descriptors(60, 0)
    assert match_count(first, descriptors(60, 1, first, 0.1)) == 60
    assert match_count(first, descriptors(60, 2)) == 0
    half = np.concatenate([descriptors(30, 3, first[:30], 0.1), descriptors(30, 4)])
    assert match_count(first, half) == 30
    assert match_count(first, first[:1]) == match_count(first[:0], first) == 0


@pytest.fixture
def database(tmp_path):
    """Eight images in a ring: each shares some things with its neighbors, more with the first; the last has none."""
    pycolmap = pytest.importorskip("pycolmap")
    place = tmp_path / "database.db"
    things = [descriptors(40, seed) for seed in range(7)]
    with pycolmap.Database.open(place) as opened:
        camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 50, 32, 24])
        camera.camera_id = opened.write_camera(camera)
        for index in range(8):
            image = pycolmap.Image(name=reconstruction.image_name(index), camera_id=camera.camera_id)
            image_id = opened.write_image(image)
            values = np.zeros((0, 128)) if index == 7 else np.concatenate([things[index], things[(index + 1) % 7][:20]])
            large = np.tile(np.float32([8, 8, 3, -3, 3, 3]), (len(values), 1))  # Turned by 45 degrees
            large[::2, 2:4] *= -1  # Mirrored
            small = np.tile(np.float32([8, 8, 1, 0, 0, 1]), (30, 1))  # Of one thing in all images, but too fine
            opened.write_keypoints(image_id, np.concatenate([large, small]))
            codes = np.round(255 * np.concatenate([values, descriptors(30, 99)]) * 2).clip(0, 255).astype(np.uint8)
            features = pycolmap.FeatureDescriptors()
            features.data = codes
            opened.write_descriptors(image_id, features)
    return place


def test_each_photo_is_paired_with_those_that_match_it_best(database, monkeypatch):
    monkeypatch.setattr(sfm_pairs, "FEATURES", 60)
    pairs = {tuple(int(Path(name).stem) for name in pair) for pair in likely_pairs(database)}
    assert pairs >= {(i, i + 1) for i in range(6)} | {(0, 6)}
    assert not any(second - first in (2, 3, 4) for first, second in pairs if second < 7)
    monkeypatch.setattr(sfm_pairs, "PARTNERS", 1)
    assert len(likely_pairs(database)) < len(pairs)


def test_photos_without_a_place_are_paired_with_all(database):
    pairs = pairs_with({reconstruction.image_name(3)}, database)
    assert len(pairs) == 7 and all(reconstruction.image_name(3) in pair for pair in pairs)


@pytest.mark.parametrize(("turned", "matches", "expected"), [(4, 60, True), (3, 60, False), (5, 59, False)])
def test_a_turn_explains_four_of_five_pairs_of_many_matches_from_one_place(database, turned, matches, expected):
    pycolmap = pytest.importorskip("pycolmap")
    kinds = pycolmap.TwoViewGeometryConfiguration
    with pycolmap.Database.open(database) as opened:
        for pair in range(5):
            kind = kinds.PLANAR_OR_PANORAMIC if pair < turned else kinds.CALIBRATED
            same = np.repeat(np.arange(matches, dtype=np.uint32)[:, None], 2, axis=1)
            opened.write_two_view_geometry(1, 2 + pair, pycolmap.TwoViewGeometry(config=kind, inlier_matches=same))
    assert from_one_place(database) is expected
