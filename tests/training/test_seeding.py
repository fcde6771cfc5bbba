"""Gaussians are born where a render does not explain its photo."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.model.color_models import make_color_model
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.prior import LightPrior
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.field import assemble_field
from sehdr_warp.scene import Camera
from sehdr_warp.scene.normalization import normalization_of
from sehdr_warp.splats.arrays import HARMONIC_0
from sehdr_warp.training.initialization import make_field, make_matcher
from sehdr_warp.training.seeding import brighten_clipped, expected_excess, make_seeds
from sehdr_warp.training.train import create_trainer
from sehdr_warp.training.training_views import ViewDataset

from .wall_and_lamp import LAMP, WALL, wall_and_lamp

LINEAR = response_by_name("linear")


def test_gaussians_are_born_where_the_photos_are_not_explained(device):
    """A field that shows the wall alone: what is born is the lamp."""
    scene = wall_and_lamp()
    config = load_config("default", {"mcmc.seed_fraction": 0.5, "schedule.iterations": 300})
    dark = [replace(v, codes=np.where(v.codes.min(2, keepdims=True) > 250, np.uint8(77), v.codes)) for v in scene.views]
    wall = replace(scene, views=tuple(dark))
    field = make_field(wall, config, LINEAR, device)
    normalized = field.normalization.scene(scene)
    views = ViewDataset(normalized.train_views, field.base_time, device, truth=False)
    matcher = make_matcher(normalized, LINEAR, device)
    with torch.no_grad():
        # Opaque, so that the wall is explained from the start.
        field.gaussians.opacity_logits.fill_(4.0)
        photo = field.render_photo(views[0].camera, views[0].exposure_time, degree=0).encoded
    budget = torch.tensor(200, device=device)
    inputs = field, matcher, photo, views[0], 0
    (rows, born), (again, roomy) = (make_seeds(*inputs, budget, room, random_seed=3) for room in (200, 300))
    assert 0 < int(born) < 200 and born == roomy
    rows, again = ({name: values[: int(born)] for name, values in each.items()} for each in (rows, again))
    assert all(torch.equal(values, again[name]) for name, values in rows.items())
    assert all(values.isfinite().all() for values in rows.values())
    none = make_seeds(*inputs, torch.tensor(0, device=device), 10, random_seed=3)
    assert not int(none[1])
    white = rows["harmonics_dc"].amax((1, 2)) == rows["harmonics_dc"].max()
    depth = torch.from_numpy(field.normalization.scene_points(rows["means"][white].cpu().numpy())[:, 2])
    assert white.float().mean() > 0.3 and ((depth - LAMP).abs() < 0.15 * LAMP).float().mean() > 0.6
    assert {name: tuple(values.shape[1:]) for name, values in rows.items()} == {
        name: tuple(values.shape[1:]) for name, values in field.gaussians.tensors().items()
    }
    # White ones are born at the light that the photo is expected to hold.
    held = torch.full((16, 16, 6), math.log(50), dtype=torch.float16, device=device)
    lit = replace(views[0], target=replace(views[0].target, estimates=held))
    brighter = make_seeds(field, matcher, photo, lit, 0, budget, 200, random_seed=3).rows["harmonics_dc"]
    rise = (brighter[: int(born)] - rows["harmonics_dc"])[:, 0] * HARMONIC_0
    torch.testing.assert_close(rise, math.log(50) * white[:, None].expand_as(rise), rtol=2e-3, atol=1e-5)


def field_of_points(scene, places, encoded, device="cpu", radiance="log"):
    """A field with a Gaussian at each place, of encoded colors, and its scene's views in its coordinates."""
    normalization = normalization_of(scene)
    points = normalization.points(np.array(places, float))
    dc = make_color_model(radiance).start(np.array(encoded, float), LINEAR)
    gaussians = Gaussians.from_points(torch.tensor(points).float(), torch.tensor(dc).float(), 0)
    config = Config.model_validate({"model": {"radiance": radiance, "sh_degree": 0}})
    field = assemble_field(gaussians, config, LINEAR, 1.0, normalization).to(device)
    return field, normalization.scene(scene).train_views


def exposures(field):
    values = field.gaussians.harmonics_dc[:, 0].detach() * HARMONIC_0
    return field.color_model.colors(values).cpu()


def estimates(views, excess, root=1.0):
    """The same estimate at every value of each photo."""
    held = torch.zeros(8, 8, 6)
    held[..., :3], held[..., 3:] = excess, root
    return [held.half() for _ in views]


@pytest.mark.parametrize("radiance", ["log", "linear"])
def test_what_is_white_starts_at_its_expected_light_and_the_rest_as_it_is(device, radiance):
    scene = wall_and_lamp()
    places = [(0, 0, LAMP), (0.1, 0.1, WALL), (0, 0, LAMP), (0, 0, -5.0)]
    encoded = [[1, 1, 1], [0.3, 0.4, 0.5], [1, 0.5, 0.2], [1, 1, 1]]
    field, views = field_of_points(scene, places, encoded, device, radiance)
    before = exposures(field)
    brighten_clipped(field, views, estimates(views, math.log(50)))
    factors = torch.ones(4, 3)
    factors[0], factors[2, 0] = 50, 50  # The last lies behind all cameras.
    torch.testing.assert_close(exposures(field) / before, factors, rtol=2e-3, atol=0)


def test_photos_agree_by_weight_and_in_the_exposure_of_the_field():
    scene = wall_and_lamp(times=(1.0, 0.25))
    field, views = field_of_points(scene, [(0, 0, LAMP)], [[1, 1, 1]])
    before = exposures(field)
    held = estimates(views, 0.0)
    for view, known in zip(views, held, strict=True):
        # Over a white of four times the light in the darker photos; these weigh three times as much.
        known[..., :3], known[..., 3:] = (math.log(16), 1.0) if view.exposure_time == 1 else (0.0, math.sqrt(3))
    brighten_clipped(field, views, held)
    bright, dark = (sum(view.exposure_time == time for view in views) for time in (1.0, 0.25))
    expected = (bright * math.log(16) + 3 * dark * math.log(4)) / (bright + 3 * dark)
    torch.testing.assert_close((exposures(field) / before).log(), torch.full((1, 3), expected), rtol=2e-3, atol=0)


def test_estimates_are_taken_where_the_photo_shows_the_gaussian():
    scene = wall_and_lamp()
    field, views = field_of_points(scene, [(0, 0, LAMP)], [[1, 1, 1]])
    before = exposures(field)
    held = [torch.zeros(64, 64, 6, dtype=torch.float16) for _ in views]
    for view, known in zip(views, held, strict=True):
        lamp = torch.from_numpy(view.codes.min(2) == 255)
        assert lamp.any()
        known[lamp] = torch.tensor([2.0] * 3 + [1.0] * 3).half()
        known[~lamp] = torch.tensor([9.0] * 3 + [1.0] * 3).half()
    brighten_clipped(field, views, held)
    torch.testing.assert_close((exposures(field) / before).log(), torch.full((1, 3), 2.0), rtol=2e-3, atol=0)


def test_panoramas_say_what_they_expect_too():
    camera = Camera(64, 32, 64 / (2 * np.pi), 64 / (2 * np.pi), 32, 16, np.eye(4), "equirectangular")
    field, views = field_of_points(wall_and_lamp(), [(0, 0, LAMP), (0, 0, -LAMP)], [[1, 1, 1]] * 2)
    before, held = exposures(field), torch.zeros(32, 64, 6)
    held[..., 3:] = 1
    held[:, 24:40, :3] = 3.0  # Ahead
    panoramas = [replace(view, camera=camera, codes=view.codes[:32], hdr=None) for view in views]
    brighten_clipped(field, panoramas, [held.half()] * len(views))
    assert (exposures(field) / before).log()[:, 0].tolist() == pytest.approx([3.0, 0.0], abs=2e-3)


def test_pixels_beyond_a_photo_count_as_the_nearest_and_nothing_is_expected_where_nothing_is_known():
    held = torch.arange(1.0, 5.0).view(2, 2, 1).repeat(1, 1, 6).half()
    pixels = torch.tensor([[0, 0], [9, 0], [0, 9], [10, 12], [-3, 4]])
    assert expected_excess(held, pixels, (10, 10))[:, 0].tolist() == [1, 2, 3, 4, 1]
    held[0, 1] = 0
    shorter = expected_excess(held, pixels, (10, 10), times=math.exp(-1.5))[:, 0]
    assert shorter.tolist() == pytest.approx([0, 0, 1.5, 2.5, 0], abs=1e-5)


def test_a_training_starts_above_white_and_asks_the_network_once(tmp_path, monkeypatch):
    calls, estimate = [], LightPrior.estimate
    monkeypatch.setattr(LightPrior, "estimate", lambda *args: (calls.append(1), estimate(*args))[1])
    scene, most = wall_and_lamp(response="srgb"), {}
    for weight in (0.01, 0.0):
        changes = {"schedule.iterations": 3, "response.name": "srgb", "loss.clipped_estimate": weight}
        trainer = create_trainer(scene, tmp_path / str(weight), load_config("fast", changes), device="cpu")
        most[weight] = float(exposures(trainer.field).max()) / trainer.field.response.white
        trainer.train()
    assert most[0.0] <= 1 < 1.1 < most[0.01]
    assert len(calls) == len(scene.train_views)
