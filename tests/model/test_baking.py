import numpy as np
import pytest
import torch

from sehdr_warp.model.baking import bake, field_of, fit_to_pictures, gaussians_of, psnr_of, sphere_directions
from sehdr_warp.rasterizer import spherical_harmonics
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera, look_at
from sehdr_warp.splats.arrays import colors_of_basis, harmonic_basis
from tests.splats.samples import gaussians

NOWHERE = np.empty((0, 3))
SRGB = response_by_name("srgb")


def evaluate_colors(gaussians, directions):
    return colors_of_basis(gaussians, harmonic_basis(directions, gaussians.degree))


def camera(x=0.0, size=32):
    return Camera(size, size, 1.2 * size, 1.2 * size, size / 2, size / 2, look_at((x, 0, -6), up=(0, -1, 0)))


def test_basis_is_that_of_the_renderer():
    directions, coefficients = sphere_directions(40), gaussians(40).harmonics
    inputs = torch.from_numpy(coefficients), torch.from_numpy(directions).float()
    rendered = spherical_harmonics(3, *inputs, torch.zeros(3))
    by_basis = np.einsum("nk,nkc->nc", harmonic_basis(directions, 3), coefficients)
    np.testing.assert_allclose(by_basis, rendered, atol=2e-5)


def test_bake_gives_back_what_harmonics_can_hold():
    start = gaussians(1030, color_model="linear")  # More than are baked at once.
    start.harmonics[:, 0] += 30  # Positive in all directions: nothing is cut off.
    baked = bake(start, lambda radiance: 2 * radiance + 0.5, "display", camera_positions=np.ones((3, 3)))
    np.testing.assert_allclose(baked.harmonics, 2 * start.harmonics, atol=1e-4)


def test_bake_follows_the_cameras_where_harmonics_cannot_hold_all():
    start = gaussians(200, color_model="log")
    positions = np.array([[x, y, -8.0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    view_directions = start.means[:, None] - positions
    view_directions /= np.linalg.norm(view_directions, axis=2, keepdims=True)
    target = SRGB.encode(evaluate_colors(start, view_directions) * 4)
    errors = []
    for inputs in (positions, NOWHERE):
        baked = bake(start, lambda radiance: SRGB.encode(radiance * 4), "display", camera_positions=inputs)
        errors.append(np.abs(evaluate_colors(baked, view_directions) - target).mean())
    assert errors[0] < 0.01 and errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("color_model", ["log", "linear", "display"])
def test_a_field_of_a_file_is_that_file(color_model):
    start = gaussians(color_model=color_model)
    field = field_of(start)
    assert field.base_time == 0.5
    same = gaussians_of(field, color_model, NOWHERE)
    np.testing.assert_allclose(same.harmonics, start.harmonics, atol=1e-5)
    # At another base time exposures differ, and radiance does not.
    hdr = field.render(camera()).hdr
    if color_model != "display":
        light = evaluate_colors(start, np.array([[0.0, 0, 1]]))
        assert 0 < hdr.max() <= light.max() * 1.001


def test_linear_radiance_is_fitted_to_logarithmic():
    start = gaussians(300)
    start.harmonics[:, 1:] *= 0.2
    linear = gaussians_of(field_of(start), "linear", NOWHERE)
    directions = sphere_directions(50)
    np.testing.assert_allclose(evaluate_colors(linear, directions), evaluate_colors(start, directions), rtol=5e-2)


def test_fused_brackets_are_fitted_in_log_radiance():
    field = field_of(gaussians())
    field.fusion = torch.nn.Module()
    field.fusion.forward = lambda logs: (0.8 * logs).exp() * 3  # pyright: ignore[reportAttributeAccessIssue]
    directions = sphere_directions(20)
    expected = 3 * (evaluate_colors(gaussians(), directions) * 0.5) ** 0.8
    colors = evaluate_colors(gaussians_of(field, "log", NOWHERE), directions)
    np.testing.assert_allclose(colors, expected, rtol=1e-4)


def test_refinement_brings_display_colors_to_the_pictures(device):
    """Bright lights over a dark ground: what blending of encoded colors gets wrong."""
    start = gaussians(400, degree=1)
    start.harmonics[::9, 0] += 12
    start.log_scales[:] -= 2.0
    field, cameras = field_of(start).to(device), [camera(x) for x in (-1, 0, 1)]
    positions = np.stack([each.position for each in cameras])
    baked = gaussians_of(field, "display", positions)
    refined = fit_to_pictures(baked, field.render_ldr, cameras, steps=60)
    renderers = (field_of(each).to(device).render_ldr for each in (baked, refined))
    before, after = (psnr_of(each, field.render_ldr, cameras) for each in renderers)
    assert after > before + 6
    np.testing.assert_array_equal(refined.means, start.means)
    assert fit_to_pictures(baked, field.render_ldr, []) is baked
