"""The cameras of a scene: paths around what they look at, and views by name."""

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.output.cameras.scene_cameras import find_view
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


@pytest.mark.parametrize(
    ("view", "photo"),
    [
        ("100_7104", "100_7104.JPG"),
        ("r.0", "r.0.png"),
        ("Bild_0___Schlo\xdf__\xe4_", "Bild 0 \u2013 Schlo\xdf (\xe4).HEIC"),
        ("Bild_0___Schlo\xdf__a__", "Bild 0 \u2013 Schlo\xdf (\xe4)"),
    ],
)
def test_a_view_is_named_as_the_file_of_its_photo(view, photo):
    """macOS writes an accent as a letter of its own, which names of views have as `_`."""
    run = AnalyticRun(((view, "train"), ("other", "test")))
    assert find_view(run, photo) is find_view(run, view) is run.cameras[0]
    assert [name for name, _ in select_cameras(run, "test", camera=photo)] == [view]
    with pytest.raises(SehdrError, match="is not one of the scene's"):
        find_view(run, f"x{photo}")


def test_photos_of_one_name_are_told_apart_by_their_folders():
    """A test view keeps the name that it shares, and others get their folder in front."""
    run = AnalyticRun((("r_0", "test"), ("train_r_0", "train")))
    assert find_view(run, "scene/train/r_0.png").name == "train_r_0"
    assert find_view(run, "test/r_0.png").name == find_view(run, "r_0.png").name == "r_0"
