"""Paths around what a scene's cameras look at."""

import numpy as np

from sehdr_warp.output.cameras.selection import select_cameras

from ..helpers import AnalyticRun, Entry, camera, sees


def test_orbit_of_parallel_cameras_uses_the_depth_seen():
    run = AnalyticRun()
    run.cameras = [
        Entry(str(i), "train", camera(position=(x, 0, -3), target=(x, 0, 0))) for i, x in enumerate((0, 0.2, 0.4))
    ]
    views = select_cameras(run, "orbit", count=8)
    assert [name for name, _ in views] == [f"orbit_{i:03d}" for i in range(8)]
    for _, view in views:  # AnalyticRun's depth is 2 everywhere: the focus lies at z = -1.
        np.testing.assert_allclose(sees(view, (0.2, 0, -1)), (view.cx, view.cy), atol=0.1)
