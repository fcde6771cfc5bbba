"""What is not done twice and not stored: renders of brackets, and harmonics that change no colour."""

import numpy as np
import pytest

from sehdr_warp.output.ply import export, without_unseen_degrees
from sehdr_warp.output.render_views import render_views

from .helpers import AnalyticRun, read_gaussians
from .test_ply import StoredRun, evaluate_colors, gaussians, sphere_directions


def test_brackets_cost_no_render(tmp_path):
    counts = []
    for name, options in (
        ("plain", {}),
        ("brackets", {"evs": [-4, -2, -1, 0, 1, 2, 4], "ldr_brackets": "png"}),
    ):
        run = AnalyticRun()
        render_views(run, tmp_path / name, **options)
        counts.append(run.rendered)
    assert counts[0] == counts[1]


@pytest.mark.parametrize("color_model,scale", [("log", 1.0), ("linear", 3.0), ("display", 1.0)])
def test_degrees_without_energy_are_left_out_to_the_bound(color_model, scale):
    full = gaussians(degree=3, color_model=color_model)
    harmonics = full.harmonics.copy()
    harmonics[:, 0] = 2 * scale
    harmonics[:, 4:] = 1e-5 * scale
    kept = without_unseen_degrees(full.with_colors(harmonics, color_model))
    assert kept.degree == 1
    directions = sphere_directions(200)
    before = evaluate_colors(full.with_colors(harmonics, color_model), directions)
    np.testing.assert_allclose(evaluate_colors(kept, directions), before, rtol=3e-4)
    harmonics[7, 5, 2] = 1e-3 * scale  # one Gaussian, one coefficient
    assert without_unseen_degrees(full.with_colors(harmonics, color_model)).degree == 2


def test_what_is_not_finite_is_not_left_out():
    full = gaussians(degree=2)
    harmonics = np.zeros_like(full.harmonics)
    harmonics[3, 8, 0] = np.nan
    assert without_unseen_degrees(full.with_colors(harmonics, "log")).degree == 2


def test_the_log_says_what_is_left_out(tmp_path, logged):
    run = StoredRun()
    export(run, tmp_path / "full.ply")
    assert logged == []
    run.model.gaussians.tensors()["harmonics_rest"][:] = 0
    export(run, tmp_path / "small.ply")
    assert read_gaussians(tmp_path / "small.ply").degree == 0
    assert len(logged) == 1 and "above degree 0" in logged[0]
    assert (tmp_path / "small.ply").stat().st_size < 0.4 * (tmp_path / "full.ply").stat().st_size
