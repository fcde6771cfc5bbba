"""Photos and points that go wrong: each trains to something sensible, or one line says why not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.training.initialization import match_points
from sehdr_warp.training.train import train

from .wall_and_lamp import WALL, in_lamp, photographed, texture, wall_and_lamp

SHORT = {"response.name": "linear", "schedule.iterations": 80, "densification.cap_max": 2500}
SHORT |= {"plan.keep": tuple(name for name in SHORT if name != "response.name")}


def decibels(run, scene) -> float:
    """Return the PSNR of the run's photos against the scene's."""
    errors = [(run.render_ldr(v.camera, v.exposure_time).cpu().numpy() - v.image) ** 2 for v in scene.views]
    return float(-10 * np.log10(np.mean(errors)))


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
        scene, tmp_path / "run", SHORT | {"schedule.iterations": 400, "densification.cap_max": 1000}, device=device
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


# White things that photos clip stay white; a lamp does not.
BY_SRGB = {"response.name": "srgb", "schedule.iterations": 250, "densification.cap_max": 2500}
BY_SRGB |= {"plan.keep": tuple(name for name in BY_SRGB if name != "response.name")}


def waves(places) -> np.ndarray:
    """[H, W, 1] smooth waves of 0 to 1 over places [H, W, 2]."""
    x, y = places[..., :1], places[..., 1:]
    return 0.5 + 0.25 * np.sin(2.1 * x + 1.3 * y) + 0.25 * np.sin(1.7 * y - 2.6 * x + 1)


def wall(_, places):
    """A white wall, evenly lit, beside a darker floor."""
    return np.where(places[..., 1:] < 0.5, 0.9 + 0.4 * waves(places), 0.4 * texture(places))


def page(_, places):
    """A printed page on a dark table."""
    x, y = places[..., :1], places[..., 1:]
    inside = (np.abs(x) < 0.8) & (np.abs(y) < 1.0)
    letters = (np.sin(18 * y) > 0.4) & (np.sin(23 * x) + np.sin(9 * x + 5 * y) > 0) & (np.abs(x) < 0.65)
    return np.where(inside, np.where(letters, 0.08, 1.3), 0.5 * texture(places))


def lamp(position, places):
    """A lamp 60 times as bright as white before a wall that it hardly lights."""
    rays = np.concatenate([(places - position[:2]) / WALL, np.ones_like(places[..., :1])], -1)
    return np.where(in_lamp(position, rays)[..., None], 60.0, 0.5 * texture(places))


def clipped_light(run, scene, surface) -> tuple[float, float, float]:
    """Return the light of clipped pixels over white: the mean of the scene, of the truth, and the scene's largest."""
    ours, truth = [], []
    for view in scene.views:
        column, row = np.meshgrid(np.arange(view.camera.width) + 0.5, np.arange(view.camera.height) + 0.5)
        rays = np.stack([(column - view.camera.cx) / view.camera.fx, (row - view.camera.cy) / view.camera.fy], -1)
        position = view.camera.position
        light = np.broadcast_to(surface(position, position[:2] + rays * WALL), view.codes.shape)
        clipped = (view.codes >= view.levels).all(2)
        rendered = run.render(view.camera).hdr.cpu().numpy() / run.field.response.white
        ours.append(rendered[clipped])
        truth.append(light[clipped])
    ours, truth = np.concatenate(ours), np.concatenate(truth)
    return float(ours.mean()), float(truth.mean()), float(np.quantile(ours, 0.99))


def train_on(surface, folder, device):
    def light_at(position, rays):
        return np.broadcast_to(surface(position, position[:2] + rays[..., :2] / rays[..., 2:] * WALL), rays.shape)

    scene = photographed(light_at, response="srgb")
    torch.manual_seed(0)
    return train(scene, folder, BY_SRGB, device=device), scene


# The largest mean over white that passes. A page on a dark table looks like a window, so it comes out brightest.
@pytest.mark.parametrize(("surface", "most"), [(wall, 2.6), (page, 4.6)])
def test_white_things_do_not_become_lamps(tmp_path, device, surface, most):
    run, scene = train_on(surface, tmp_path / "run", device)
    mean, true, largest = clipped_light(run, scene, surface)
    assert true < 1.35 and 1 < mean < most and largest < 4 * most


def test_a_lamp_does(tmp_path, device):
    run, scene = train_on(lamp, tmp_path / "run", device)
    mean, true, _ = clipped_light(run, scene, lamp)
    assert true > 20 and mean > 8


@pytest.mark.parametrize(
    "count, options, words",
    [
        (0, {}, "count 0 is below 1"),
        ("100", {}, "count is '100', expected a whole number"),
        (9, {"seed": -1}, "seed -1 is below 0"),
        (9, {"response": "srgb"}, "response is 'srgb', expected a curve, as response_by_name"),
        (9, {"device": "gpu"}, "device gpu: is neither a CPU nor a CUDA GPU"),
    ],
)
def test_points_are_not_matched_by_options_that_cannot_be(count, options, words):
    with pytest.raises((SehdrError, TypeError), match=words):
        match_points(wall_and_lamp(), count, **options)
