"""Photos and points that go wrong: each trains to something sensible, or one line says why not."""

from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.training.train import train

from .wall_and_lamp import in_lamp, photographed, texture, wall_and_lamp

SHORT = {"response.name": "linear", "schedule.iterations": 80, "densification.cap_max": 2500}
SHORT |= {"plan.keep": tuple(name for name in SHORT if name != "response.name")}


def decibels(run, scene) -> float:
    """Of the run's photos against the scene's."""
    errors = [(run.render_ldr(v.camera, v.exposure_time).cpu().numpy() - v.image) ** 2 for v in scene.views]
    return float(-10 * np.log10(np.mean(errors)))


def test_points_that_mislead(tmp_path, device):
    scene, rng = wall_and_lamp(), np.random.default_rng(0)
    clouds = {
        "behind": rng.normal(0, 1, (300, 3)) - [0, 0, 5],
        "one place": np.tile([0.0, 0.0, 3.0], (300, 1)),
    }
    for name, points in clouds.items():
        colors = np.full(points.shape, 0.5, np.float32)
        odd_scene = replace(scene, points=points, point_colors=colors)
        assert decibels(train(odd_scene, tmp_path / name, SHORT, device=device), scene) > 26, name


def test_two_photos_are_refused(tmp_path):
    scene = wall_and_lamp()
    with pytest.raises(InputError, match="2 training photos: depth and light cannot be told apart"):
        train(replace(scene, views=scene.views[:2]), tmp_path / "run", SHORT, device="cpu")


def test_a_lamp_in_the_dark(tmp_path, device):
    scene = photographed(lambda position, rays: 1e3 * in_lamp(position, rays)[..., None].repeat(3, -1))
    run = train(scene, tmp_path / "run", SHORT | {"schedule.iterations": 200}, device=device)
    for view in scene.views:
        picture, lit = run.render_ldr(view.camera, 1.0).cpu().numpy(), view.codes.min(2) > 0
        assert picture[lit].mean() > 0.7 and picture[~lit].mean() < 0.02


def test_a_sky_that_fills_the_photo(tmp_path, device):
    """Light by direction alone, which hardly two photos agree on a depth of: few points to start from."""
    scene = photographed(lambda _, rays: texture(4 * rays[..., :2] / rays[..., 2:]), turn=0.2)
    flat = -10 * np.log10(np.mean([np.var(view.image, axis=(0, 1)) for view in scene.views]))
    run = train(
        scene,
        tmp_path / "run",
        SHORT | {"schedule.iterations": 400, "densification.cap_max": 1000},
        device=device,
    )
    assert decibels(run, scene) > flat + 2


def test_exposure_that_drifts_by_four_stops_unsaid(tmp_path, device):
    scene = wall_and_lamp((1.5, 0.4, 1.5 / 16), "srgb")
    unsaid = replace(
        scene, views=tuple(replace(view, exposure_time=1.0) for view in scene.views), exposure_times_known=False
    )
    run = train(unsaid, tmp_path / "run", SHORT | {"response.name": "srgb"}, device=device)
    times = [
        view.exposure_time / true.exposure_time for view, true in zip(run.normalize_photos(unsaid).views, scene.views)
    ]
    assert np.log2(max(times) / min(times)) < 0.15
    assert decibels(run, run.normalize_photos(unsaid)) > 26
