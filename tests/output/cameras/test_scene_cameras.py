"""Points and directions that a scene's cameras look at."""

import numpy as np

from sehdr_warp.output.cameras.scene_cameras import common_focus
from sehdr_warp.output.cameras.selection import select_cameras

from ..helpers import AnalyticRun, Entry, arc, camera, sees


def test_common_focus_is_where_the_axes_meet():
    np.testing.assert_allclose(common_focus(arc(5, 60)), 0, atol=1e-9)
    parallel = [camera(position=(x, 0, -3), target=(x, 0, 0)) for x in (0, 0.1, 0.2)]
    assert common_focus(parallel) is None
    away = [camera(position=(x, 0, -3), target=(3 * x, 0, -9)) for x in (-1.0, -0.5, 0.5, 1.0)]
    assert common_focus(away) is None


def test_orbit_of_parallel_cameras_uses_the_depth_seen():
    run = AnalyticRun()
    run.cameras = [
        Entry(str(i), "train", camera(position=(x, 0, -3), target=(x, 0, 0))) for i, x in enumerate((0, 0.2, 0.4))
    ]
    views = select_cameras(run, "orbit", count=8)
    assert [name for name, _ in views] == [f"orbit_{i:03d}" for i in range(8)]
    for _, view in views:  # AnalyticRun's depth is 2 everywhere: the focus lies at z = -1.
        np.testing.assert_allclose(sees(view, (0.2, 0, -1)), (view.cx, view.cy), atol=0.1)
