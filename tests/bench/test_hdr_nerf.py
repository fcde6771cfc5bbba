"""HDR-NeRF in torch: its parts against what they must be, and that it learns."""

import dataclasses

import numpy as np
import pytest
import torch

from sehdr_warp.bench.hdr_nerf import (
    Bounds,
    HdrNerfSettings,
    camera_rays,
    encoding,
    importance_depths,
    ray_weights,
    stratified_depths,
    train_hdr_nerf,
    unit_value,
)
from sehdr_warp.errors import InputError

from ..training.toy import EXPOSURE_TIME, toy_scene

SMALL = HdrNerfSettings(
    depth=3, width=32, samples=8, more_samples=8, rays=128, positions=4, directions=1, rate=8e-3, unit_value=0.73
)


@pytest.fixture(scope="module")
def scene():
    return toy_scene(size=12)


@pytest.fixture(scope="module")
def run(scene):
    return train_hdr_nerf(scene, iterations=150, settings=SMALL, evaluate_at=(5,))


def constant_psnr(scene) -> float:
    """The best that one colour for all pixels could do on the held-out photos, dB."""
    mean = np.mean([view.image.mean((0, 1)) for view in scene.train_views], axis=0)
    return float(-10 * np.log10(np.mean([np.square(view.image - mean).mean() for view in scene.test_views])))


def test_it_learns_a_scene_better_than_a_constant(scene, run):
    first, last = run.history
    assert (first["iteration"], last["iteration"]) == (5, 150)
    assert last["psnr_ldr"] > constant_psnr(scene) + 2.5 and last["psnr_ldr"] > first["psnr_ldr"] + 2.5
    assert run.train_seconds == pytest.approx(last["seconds"], abs=1e-3) and last["seconds"] > first["seconds"] > 0


def test_what_it_renders_has_the_shapes_and_ranges_of_a_run(scene, run):
    camera = scene.test_views[0].camera
    view, photo = run.render(camera), run.render_ldr(camera)
    assert view.hdr.shape == photo.shape == (12, 12, 3) and view.alpha.shape == view.depth.shape == (12, 12)
    assert bool((view.hdr > 0).all()) and bool(((photo > 0) & (photo < 1)).all())
    assert bool((view.alpha > 0.99).all()), "the last sample reaches to infinity"
    assert run.exposure_time == EXPOSURE_TIME and run.iterations == 150
    # Two stops more light: the tone mapper is asked about other exposures.
    assert not torch.allclose(run.render_ldr(camera, 4 * EXPOSURE_TIME), photo, atol=1e-3)


def test_the_unit_exposure_is_held(run):
    for field in run.fields:
        assert field.tone_mapper.encode_log(torch.zeros(1, 3)).detach().numpy() == pytest.approx(0.73, abs=0.1)


def test_a_seed_is_a_result_and_truth_is_not_looked_at(scene):
    views = tuple(dataclasses.replace(view, hdr=None) for view in scene.views)
    runs = [
        train_hdr_nerf(given, iterations=3, settings=SMALL, seed=seed)
        for given, seed in ((scene, 1), (dataclasses.replace(scene, views=views), 1), (scene, 2))
    ]
    camera = scene.test_views[0].camera
    first, blind, other = (each.render_ldr(camera) for each in runs)
    assert torch.equal(first, blind) and not torch.allclose(first, other)
    assert "psnr_mu" in runs[0].history[-1] and "psnr_mu" not in runs[1].history[-1]


def test_seconds_end_a_training(scene):
    run = train_hdr_nerf(scene, seconds=0.05, settings=SMALL)
    assert run.iterations >= 1 and run.train_seconds >= 0.05
    with pytest.raises(ValueError, match="seconds"):
        train_hdr_nerf(scene, settings=SMALL)


def test_a_known_response_says_what_the_unit_exposure_is():
    assert unit_value("hdr-nerf") == pytest.approx(0.73, abs=1e-3)
    assert (unit_value("auto"), unit_value("srgb")) == (0.5, 0.995)


def test_one_view_is_refused(scene):
    with pytest.raises(InputError, match="1 training view"):
        train_hdr_nerf(dataclasses.replace(scene, views=scene.views[:1]), iterations=1, settings=SMALL)


def test_weights_composite_front_to_back():
    depths = torch.tensor([[1.0, 2.0, 4.0]])
    weights = ray_weights(torch.tensor([[0.5, 0.0, 3.0]]), depths)
    first = 1 - np.exp(-0.5)
    assert weights[0].numpy() == pytest.approx([first, 0.0, 1 - first], rel=1e-6)


def test_samples_lie_where_they_should():
    generator = torch.Generator().manual_seed(0)
    depths = stratified_depths(2.0, 6.0, 500, 4, generator, "cpu")
    assert bool(((depths - 2.0).floor() == torch.arange(4)).all())
    assert stratified_depths(2.0, 6.0, 1, 4, None, "cpu")[0].tolist() == [2.5, 3.5, 4.5, 5.5]
    # All the weight on the second of four samples: between the middles beside it.
    weights = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(500, 4)
    drawn = importance_depths(torch.tensor([[2.5, 3.5, 4.5, 5.5]]).expand(500, 4), weights, 16, generator)
    assert float(((drawn >= 3.0) & (drawn <= 4.0)).float().mean()) > 0.99
    even = importance_depths(torch.tensor([[2.5, 3.5, 4.5, 5.5]]), weights[:1], 4, None)
    assert even[0].numpy() == pytest.approx([3.125, 3.375, 3.625, 3.875], abs=1e-3)


def test_rays_pass_through_pixel_centres_and_bounds_hold_the_scene(scene):
    view = scene.views[0]
    origins, directions = camera_rays(view.camera)
    local = directions.reshape(12, 12, 3)[3, 8] @ view.camera.world_to_camera[:3, :3].T
    assert local[:2] / local[2] * view.camera.fx + 6 == pytest.approx([8.5, 3.5], abs=1e-4)
    assert np.allclose(origins, view.camera.position)
    bounds = Bounds.of(scene)
    distances = np.linalg.norm(scene.points - view.camera.position, axis=1)
    assert bounds.near < distances.min() and bounds.far > distances.max()
    ends = origins + bounds.far * directions
    assert float(np.abs((ends - np.array(bounds.centre)) / bounds.radius).max()) <= 1.0 + 1e-6


def test_encoding_is_the_papers():
    values = torch.tensor([[0.3, -0.2]])
    encoded = encoding(values, 2)[0].tolist()
    expected = [0.3, -0.2, *np.sin([0.3, 0.6, -0.2, -0.4]), *np.cos([0.3, 0.6, -0.2, -0.4])]
    assert encoded == pytest.approx(expected, abs=1e-6)
