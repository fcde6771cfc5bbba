"""Pixels of two photos that show one point."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.load import parse_dataset
from sehdr_warp.scene.shared_pixels import SharedPixels, candidate_pairs, shared_pixels
from tests.make_scenes import write_colmap


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


@pytest.mark.parametrize("step", [(-0.5, 0.1, 0.2), (0.02, 0.01, 0.6)])
def test_only_poses_that_see_the_points_in_front_of_both_cameras_fit(step):
    """Four pairs of poses have one epipolar geometry; the points lie behind a camera in three of them."""
    lens = Lens("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0), Path("cameras.txt"))
    points = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 5), (100, 3))
    turn, step = Rotation.from_euler("xyz", (5, -10, 100), degrees=True).as_matrix(), np.array(step)
    second_points = points @ turn.T + step
    places = [500 * each[:, :2] / each[:, 2:] + (320, 240) for each in (points, second_points)]
    shared = SharedPixels((0, 1), (lens, lens), (places[0], places[1]))
    twist = Rotation.from_rotvec(np.pi * step / np.linalg.norm(step)).as_matrix()
    for rotation, translation in ((turn, step), (turn, -step), (twist @ turn, step), (twist @ turn, -step)):
        second = np.eye(4)
        second[:3, :3], second[:3, 3] = rotation, translation
        right = rotation is turn and translation is step
        assert (shared.distance(shared.lenses, np.eye(4), second) < 1e-6) is right


def test_pairs_with_a_photo_that_cannot_be_compared_are_left_out(tmp_path):
    write_colmap(tmp_path, size=(320, 240))
    noise = np.random.default_rng(0).uniform(0, 255, (60, 80)).astype(np.uint8)
    wall = Image.fromarray(noise).resize((400, 300), Image.Resampling.BICUBIC)
    records = parse_dataset(tmp_path).records[:4]
    for i, record in enumerate(records):
        wall.crop((10 * i, 5 * i, 320 + 10 * i, 240 + 5 * i)).convert("RGB").save(record.image)
    records[1].image.write_bytes(b"damaged")
    Image.fromarray(np.full((240, 320), 999, np.uint16)).save(records[2].image)
    (shared,) = shared_pixels(records, [(0, 1), (1, 3), (0, 2), (2, 3), (0, 3)])
    assert shared.indices == (0, 3) and len(shared.places[0]) >= 30
    shift = shared.places[0] - shared.places[1]
    np.testing.assert_allclose(np.median(shift, 0), (30, 15), atol=0.5)
