"""The point that cameras look at together."""

import numpy as np
import pytest

from sehdr_warp.scene.camera_focus import common_focus, map_center

from ..output.helpers import arc, camera


def test_common_focus_is_where_the_axes_meet():
    np.testing.assert_allclose(common_focus(arc(5, 60)), 0, atol=1e-9)
    parallel = [camera(position=(x, 0, -3), target=(x, 0, 0)) for x in (0, 0.1, 0.2)]
    assert common_focus(parallel) is None
    away = [camera(position=(x, 0, -3), target=(3 * x, 0, -9)) for x in (-1.0, -0.5, 0.5, 1.0)]
    assert common_focus(away) is None


def test_a_walk_is_around_what_cameras_on_all_sides_look_at():
    around = arc(12, 360, 4.0, 0.3)
    center = map_center(around)
    np.testing.assert_allclose(center.position, 0, atol=1e-6)
    assert center.beyond == pytest.approx(0.5 * np.hypot(4, 0.3))
    outwards = [camera(position=each.position, target=2 * each.position) for each in around]
    for photos in (around[:4], outwards, around[::6]):  # An arc, a room seen from within, two cameras
        center = map_center(photos)
        np.testing.assert_allclose(center.position, np.mean([each.position for each in photos], axis=0))
        assert center.beyond == 0
