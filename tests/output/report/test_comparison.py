"""Photo, scene and truth beside each other."""

from dataclasses import replace

import numpy as np

from sehdr_warp.output.images.display import display_gain, encode_srgb
from sehdr_warp.output.report.comparison import Comparison, compare, darker_stops, first_picture

from ..helpers import make


def test_the_first_picture_shows_what_photos_clip_as_grey():
    flat = np.full((4, 4, 3), 2.0)
    thumbnail = Comparison("v", np.ones((4, 4, 3)), flat, flat * 30, 0.5, 1.0)
    # White of 2 s^-1 for half a second is an exposure of 1: two stops darker it is a quarter.
    assert darker_stops([thumbnail]) == -2
    assert darker_stops([replace(thumbnail, gain=8.0)]) == -5
    times = [darker_stops([replace(thumbnail, exposure_time=time)]) for time in (1e-9, 1e9)]
    assert times == [-1, -12]
    assert first_picture(thumbnail).lead == "View v, 2 stops darker. What the photo clipped stays flat."


def test_a_photo_that_clips_nothing_is_opened_as_it_was_taken():
    flat = np.full((4, 4, 3), 0.5)
    first = first_picture(Comparison("v", flat, flat, flat, 0.5, 1.0))
    assert (first.stops, first.title) == (0, "Photo and scene") and "next to no light" in first.lead


def test_a_scene_without_light_above_white_is_not_opened_dark():
    white, flat = np.ones((4, 4, 3)), np.full((4, 4, 3), 2.0)
    assert first_picture(Comparison("v", white, flat, flat, 0.5, 1.0)).title == "Photo and scene"
    steep = flat * [[[1.0, 1.0, 0.01]]]  # Of a code just below white, which a steep response decodes to far less
    assert first_picture(Comparison("v", white, steep, flat, 0.5, 1.0)).title == "Photo and scene"


def test_photos_in_a_sensors_colors_are_shown_as_the_scene_is(tmp_path):
    run, scene = make(tmp_path)
    view, plain = scene.views[0], compare(run, scene.views[0], scene.views)
    run.color_matrix = np.eye(3)[::-1].copy()
    run.base_time = 0.5 / plain.from_photo.max()  # What is white in a channel counts as clipped: see rec709_of().
    compared = compare(run, view, scene.views)
    np.testing.assert_allclose(compared.from_photo, plain.from_photo[..., ::-1], rtol=1e-5, atol=1e-6)
    light = compared.from_photo * view.exposure_time * display_gain(run.response)
    np.testing.assert_allclose(compared.photo, encode_srgb(light), atol=1e-6)
