"""Shapes fitted to the Gaussians of a light."""

import numpy as np
import pytest

from sehdr_warp.model.light_shapes import fitted_shape

from .test_lights import ball, panel


def round_axes(places, width):
    return np.tile(width * np.eye(3), (len(places), 1, 1))


def test_a_window_of_uncertain_depth_is_a_rectangle_and_half_a_ball_a_sphere():
    places = panel(1.2, 0.6)
    places[:, 2] += np.random.default_rng(0).normal(0, 0.08, len(places))
    window = fitted_shape(places, round_axes(places, 0.05), np.ones(len(places)), np.zeros(3))
    assert window.kind == "rect" and window.size == pytest.approx((1.2, 0.6), rel=0.1)
    assert window.axes[2] == pytest.approx([0, 0, -1], abs=0.1)
    large = fitted_shape(places, round_axes(places, 0.2), np.ones(len(places)), np.zeros(3))
    assert large.kind == "rect" and large.axes[2] == pytest.approx([0, 0, -1], abs=0.1)
    places[:, 2] += np.random.default_rng(1).normal(0, 0.15, len(places))  # Joined with what is behind it
    joined = fitted_shape(places, round_axes(places, 0.05), np.ones(len(places)), np.array([1.0, 0, 0]))
    assert joined.kind == "rect" and joined.size == pytest.approx((1.2, 0.6), rel=0.2)
    assert joined.axes[2] == pytest.approx([0, 0, -1], abs=0.15)
    half = ball((0, 0, 4))
    half = half[half[:, 2] < 4]
    assert fitted_shape(half, round_axes(half, 0.03), 4 - half[:, 2], np.zeros(3)).kind == "sphere"
