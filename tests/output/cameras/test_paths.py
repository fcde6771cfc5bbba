"""Orbits, interpolations and walks."""

from itertools import pairwise

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.output.cameras.paths import interpolate, orbit
from sehdr_warp.output.render_views import render_views

from ..helpers import AnalyticRun, arc, camera, sees


@pytest.mark.parametrize("degrees", [60, 360])
def test_orbit_looks_at_the_focus_smoothly(degrees):
    camera_path = arc(12, degrees)
    path = orbit(camera_path, 48, 1)
    positions = np.stack([view.position for view in path])
    for view in path:
        np.testing.assert_allclose(sees(view, np.zeros(3)), (view.cx, view.cy), atol=1e-6)
        assert view.world_to_camera[1, :3] @ [0, 1, 0] > 0.9
        np.testing.assert_allclose(np.linalg.norm(view.position), np.linalg.norm(camera_path[0].position), rtol=1e-6)
    steps = np.linalg.norm(np.diff(positions, axis=0, append=positions[:1]), axis=1)
    assert steps.max() < 4 / len(path) * np.ptp(positions, axis=0).max()
    azimuth = np.degrees(np.arctan2(positions[:, 0], -positions[:, 2]))
    assert np.ptp(azimuth) > 300 if degrees == 360 else np.abs(azimuth).max() < 30


def test_orbit_follows_an_arc_that_goes_up_and_down():
    # A hand-held walk over a mound and around a corner: higher and farther away in the middle.
    angles = np.radians(np.linspace(-34, 34, 10))
    heights, distances = 0.6 - 9 * (angles - 0.1) ** 2 / 4, 12 - 5 * angles**2
    camera_path = [
        camera(position=(d * np.sin(a), -h, -d * np.cos(a))) for a, h, d in zip(angles, heights, distances, strict=True)
    ]
    for view in orbit(camera_path, 48, 1):
        x, y, z = view.position
        near = np.argsort(np.abs(angles - np.arctan2(x, -z)))[:2]
        assert heights[near].min() - 0.05 < -y < heights[near].max() + 0.05
        assert distances[near].min() - 0.1 < np.hypot(x, z) < distances[near].max() + 0.1


def test_interpolation_passes_through_its_cameras():
    camera_path = arc(5, 90)
    path = interpolate(camera_path, 41)
    assert len(path) == 41
    for i, view in enumerate(camera_path):
        np.testing.assert_allclose(path[10 * i].world_to_camera, view.world_to_camera, atol=1e-6)
    turns = [np.linalg.norm(a.world_to_camera - b.world_to_camera) for a, b in pairwise(path)]
    assert max(turns) < 1.5 * min(turns)
    repeated = interpolate([camera_path[0], camera_path[0], camera_path[1]], 3)
    np.testing.assert_allclose(repeated[2].world_to_camera, camera_path[1].world_to_camera, atol=1e-9)
    assert len(interpolate(camera_path[:1], 4)) == 4


def test_paths_need_cameras(tmp_path):
    with pytest.raises(SehdrError, match=r"no training views.*file of cameras"):
        interpolate([], 3)
    for choice in ("test", "all", "orbit"):  # As of a file of Gaussians without a file of cameras beside it
        with pytest.raises(SehdrError, match=rf"no cameras of its own, and {choice} needs them; .*which export writes"):
            render_views(AnalyticRun([]), tmp_path / "out", cameras=choice)
    with pytest.raises(SehdrError, match="no cameras, and so no view 'r_0'"):
        render_views(AnalyticRun([]), tmp_path / "out", camera="r_0")
    with pytest.raises(SehdrError, match="path cannot have 0 views"):
        orbit(arc(3, 30), 0, 1)
