"""The coordinates of a training: a similarity that depends on cameras and points alone, exact where float32 is not."""

from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.scene import Camera, Scene, View
from sehdr_warp.scene.camera import look_at
from sehdr_warp.scene.normalization import MARGIN, POINT_SHARE, Normalization, normalization_of

UTM = np.array([500_000.0, 4_200_000.0, 100.0])


def ring(scale=1.0, shift=0.0, radius=1.0):
    """Six cameras on a circle that look at its center, and some points."""
    angles = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    views = []
    for index, angle in enumerate(angles):
        direction = np.array([np.cos(angle), np.sin(angle), 0.5])
        pose = look_at(direction)
        pose[:3, 3] = -pose[:3, :3] @ (radius * direction * scale + shift)
        camera = Camera(8, 6, 7.0, 7.0, 4.0, 3.0, pose)
        views.append(View(str(index), np.full((6, 8, 3), 99, np.uint8), camera, 1.0, "train" if index else "test"))
    points = np.random.default_rng(0).normal(size=(20, 3)) * scale + shift
    return Scene("ring", "photos", tuple(views), points, np.zeros((20, 3), np.float32))


def test_training_cameras_are_in_the_unit_ball_around_their_mean():
    scene = ring(scale=37.0, shift=UTM)
    inside = normalization_of(scene).scene(scene)
    positions = np.stack([view.camera.position for view in inside.train_views])
    np.testing.assert_allclose(positions.mean(0), 0, atol=1e-9)
    assert np.linalg.norm(positions, axis=1).max() == pytest.approx(1 / MARGIN)
    assert all(a.codes is b.codes for a, b in zip(scene.views, inside.views, strict=True))


@pytest.mark.parametrize("scale, shift", [(16.0, 0.0), (0.01, 0.0), (1.0, UTM), (100.0, -UTM)])
def test_unit_and_origin_of_the_scene_do_not_matter(scale, shift):
    plain, moved = ring(), ring(scale, shift)
    plain, moved = (normalization_of(scene).scene(scene) for scene in (plain, moved))
    for one, other in zip(plain.views, moved.views, strict=True):
        np.testing.assert_allclose(one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-7)
    np.testing.assert_allclose(plain.points, moved.points, atol=1e-7)


def test_points_and_cameras_return_to_the_scene():
    normalization = Normalization(UTM, 12.5)
    points = UTM + np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_allclose(normalization.scene_points(normalization.points(points)), points, rtol=0, atol=1e-8)
    assert Normalization.from_dict(normalization.to_dict()).to_dict() == normalization.to_dict()
    camera = ring().views[0].camera
    assert Normalization().camera(camera) is camera


def test_cameras_at_one_place_take_the_unit_from_the_points():
    scene = ring(shift=np.array([3.0, 0, 0]), radius=0.0)
    distance = np.median(np.linalg.norm(scene.points - scene.views[0].camera.position, axis=1))
    assert normalization_of(scene).unit == pytest.approx(POINT_SHARE * distance)
    assert normalization_of(replace(scene, points=scene.points[:0], point_colors=scene.point_colors[:0])).unit == 1.0


@pytest.mark.parametrize("center, unit", [((0, 0, np.nan), 1.0), ((0, 0), 1.0), ((0, 0, 0), 0.0), ((0, 0, 0), np.inf)])
def test_a_normalization_is_finite_and_positive(center, unit):
    with pytest.raises(ValueError, match="normalization"):
        Normalization(np.array(center), unit)
