"""Pixels of two photos that show one point."""

from pathlib import Path

import numpy as np
import pycolmap

from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.load import parse_dataset
from sehdr_warp.scene.shared_pixels import SharedPixels, candidate_pairs


def test_photos_of_one_place_are_not_compared():
    """Pairs of one bracket fit any poses."""
    thrice = [record for record in parse_dataset("embedded").records[:14] for _ in range(3)]
    pairs = candidate_pairs(thrice)
    assert len(pairs) >= 8
    assert all(i // 3 != j // 3 for i, j in pairs)


def test_pixels_beyond_the_model_of_a_lens_do_not_count():
    lens = Lens("RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3, 0.0), Path("cameras.txt"))
    camera = pycolmap.Camera(model=lens.model, width=640, height=480, params=list(lens.params))
    points = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 5), (100, 3))
    first, second = np.eye(4), np.eye(4)
    second[:3, 3] = -0.5, 0.1, 0.05
    corner = np.full((1, 2), 3.0)
    places = [np.concatenate([camera.img_from_cam(points + pose[:3, 3]), corner]) for pose in (first, second)]
    assert np.isnan(camera.cam_from_img(corner)).all()
    shared = SharedPixels((0, 1), (lens, lens), (places[0], places[1]))
    assert shared.distance(shared.lenses, first, second) < 1e-6
