"""Exposure times of photos that state none."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera, Scene, View
from sehdr_warp.scene.exposure.estimate import with_estimated_times


def scene_of(levels, times):
    """Views `0`, `1`, ... of one grey level each, without points."""
    camera = Camera(16, 12, 15.0, 15.0, 8.0, 6.0, np.eye(4))
    views = tuple(
        View(str(i), np.full((12, 16, 3), level, np.uint8), camera, time, "test", None, None, None)
        for i, (level, time) in enumerate(zip(levels, times, strict=True))
    )
    none = np.zeros((0, 3))
    return Scene("s", "f", views, none, none, True, (), response=response_by_name("srgb"))


def test_views_without_a_timed_one_beside_them_keep_their_guess():
    scene = with_estimated_times(scene_of([128, 60], [0.5, 0.25]), {"0", "1"}, response_by_name("srgb"))
    assert [view.exposure_time for view in scene.views] == [0.5, 0.25]
    assert scene.notes == (
        "2 photos do not state their exposure: 1/4 to 0.5 s as a guess, because no photo beside states one (0, 1)",
    )


def test_a_view_gets_the_time_by_its_brightness_beside_a_timed_one():
    response = response_by_name("linear")
    scene = with_estimated_times(scene_of([120, 60], [0.5, 0.5]), {"1"}, response)
    assert scene.views[1].exposure_time == pytest.approx(0.25, rel=0.02)
    assert "by brightness beside the others" in scene.notes[0]


def test_a_channel_that_clips_in_the_other_photos_is_left_out_without_a_warning():
    response = response_by_name("linear")
    scene = scene_of([120, 60], [0.5, 0.5])
    red_clips = np.full((12, 16, 3), 120, np.uint8)
    red_clips[..., 0] = 255
    column, row = np.meshgrid(np.arange(6) - 3, np.arange(5) - 2)
    points = np.stack([column.ravel(), row.ravel(), np.full(30, 15)], axis=1).astype(float)
    views = (replace(scene.views[0], codes=red_clips), scene.views[1])
    scene = replace(scene, views=views, points=points, point_colors=np.zeros((30, 3)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = with_estimated_times(scene, {"1"}, response)
    assert scene.views[1].exposure_time == pytest.approx(0.25, rel=0.02)
    assert "by points that other photos show too" in scene.notes[0]
