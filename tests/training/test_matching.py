"""Points matched between photos lie on what the photos show, and errors are where Gaussians are born."""

import gc
import math
import weakref
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.rasterizer.ops.plane_sweep import BORDER
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.splats.arrays import HARMONIC_0
from sehdr_warp.training.initialization import make_field, make_matcher, start_count, start_points
from sehdr_warp.training.seeding import make_seeds
from sehdr_warp.training.train import create_trainer, train
from sehdr_warp.training.training_views import ViewDataset

from .wall_and_lamp import LAMP, WALL, wall_and_lamp

LINEAR = response_by_name("linear")


def matched(scene, device, count=700):
    matcher = make_matcher(scene, LINEAR, device)
    return matcher.match(matcher.pixels(count, np.random.default_rng(0)))


@pytest.mark.parametrize("times", [(1.0,), (1.0, 0.5, 0.7)], ids=["one exposure", "exposures that drift"])
def test_matched_points_lie_on_wall_and_lamp(device, times):
    matches = matched(wall_and_lamp(times), device)
    depth, white = matches.points[:, 2].cpu().numpy(), (matches.colors > 0.99).all(1).cpu().numpy()
    assert len(depth) > 280
    assert (np.abs(depth[~white] - WALL) < 0.1 * WALL).mean() > 0.9
    if len(times) == 1:
        assert white.sum() >= 3 and (np.abs(depth[white] - LAMP) < 0.1 * LAMP).mean() > 0.8
    np.testing.assert_allclose(matches.footprints.cpu(), depth / 70, rtol=1e-4)


def test_dark_photos_are_matched_as_bright_ones_are(device):
    """Photos of 16 bits at a sixteenth of their values; colors of the points stay those of the photos."""
    scene = wall_and_lamp()
    dark = replace(scene, views=tuple(replace(v, codes=v.codes.astype(np.uint16) * 16) for v in scene.views))
    bright, matches = matched(scene, device), matched(dark, device)
    assert len(matches.points) > 0.8 * len(bright.points)
    depth, colors = matches.points[:, 2].cpu().numpy(), matches.colors.cpu().numpy()
    wall = colors.max(1) < 0.05
    assert (np.abs(depth[wall] - WALL) < 0.1 * WALL).mean() > 0.9
    assert colors.max() == pytest.approx(255 * 16 / 65535, abs=0.004)


def test_points_that_mislead_do_no_harm(device):
    """Behind the cameras, all in one place, or far beyond: depths come from the photos."""
    scene, rng = wall_and_lamp(), np.random.default_rng(0)
    clouds = rng.normal(0, 1, (200, 3)) - [0, 0, 5], np.tile([0.0, 0.0, 3.0], (200, 1)), rng.normal(0, 9, (200, 3)) + 40
    for points in clouds:
        matches = matched(replace(scene, points=points, point_colors=np.full(points.shape, 0.5, np.float32)), device)
        depth = matches.points[:, 2]
        assert len(depth) > 190 and ((depth - WALL).abs() < 0.1 * WALL).float().mean() > 0.8


def test_pixels_repeat_and_avoid_borders_and_masks(device):
    scene = wall_and_lamp()
    mask = np.zeros((64, 64), np.float32)
    mask[:, 32:] = 1
    matcher = make_matcher(
        replace(scene, views=tuple(replace(view, mask=mask) for view in scene.views)), LINEAR, device
    )
    pixels, again = (matcher.pixels(500, np.random.default_rng(1)) for _ in range(2))
    assert torch.equal(pixels, again) and (pixels[:, 1] >= 32).all()
    assert pixels[:, 1:].min() >= BORDER and pixels[:, 1:].max() < 64 - BORDER
    assert 150 < len(pixels) < 500 and set(pixels[:, 0].tolist()) == set(range(9))


def never():
    raise AssertionError("nothing is to be matched")


def test_start_points_are_the_scenes_and_matched_ones():
    scene, config = wall_and_lamp(), load_config("default", {"model.initial_density": 4.0})
    assert start_count(config, 9 * 64 * 64) == 768
    own = np.array([[0.0, 0.0, 3.0]] * 300)
    inputs = replace(scene, points=own, point_colors=np.full((300, 3), 0.5, np.float32))
    points, colors = start_points(
        inputs, config, partial(make_matcher, inputs, LINEAR, "cpu"), np.random.default_rng(0)
    )
    assert 300 < len(points) == len(colors) <= 800 and np.array_equal(points[:300], own)
    none = load_config("default", {"model.initial_density": 0.0})
    assert len(start_points(inputs, none, never, np.random.default_rng(0))[0]) == 300
    # Without any, they are drawn where cameras look.
    assert len(start_points(scene, none, never, np.random.default_rng(0))[0]) == 5000


def test_a_training_frees_the_matcher_after_the_last_refinement(tmp_path):
    fields = {"schedule.iterations": 90, "plan.enabled": False}
    trainer = create_trainer(wall_and_lamp(), tmp_path / "run", load_config("default", fields), device="cpu")
    matcher, was_over = weakref.ref(trainer._get_matcher()), []
    for step in trainer:
        was_over.append(trainer.strategy.schedule.is_over(step.iteration))
        if was_over[-1] and matcher() is not None:
            gc.collect()  # It takes a tenth of a second.
        assert (matcher() is None) == was_over[-1]
    assert was_over[-1] and not was_over[0]


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


def test_a_scene_of_two_photos_or_of_none_that_match_still_starts(tmp_path):
    scene = wall_and_lamp()
    two = replace(scene, views=scene.views[:2])
    config = load_config("default", {"schedule.iterations": 3, "plan.enabled": False, "response.name": "linear"})
    assert train(two, tmp_path / "two", config, device="cpu").summary()["iteration"] == 3
    rng = np.random.default_rng(0)
    noise = tuple(replace(v, codes=rng.integers(0, 256, v.codes.shape, dtype=np.uint8)) for v in scene.views)
    assert train(replace(scene, views=noise), tmp_path / "noise", config, device="cpu").summary()["iteration"] == 3


def test_back_to_back_photos_are_refused(tmp_path):
    scene = wall_and_lamp()
    turned = scene.views[1].camera.world_to_camera.copy()
    turned[[0, 2]] *= -1
    other = replace(scene.views[1], camera=replace(scene.views[1].camera, world_to_camera=turned))
    two = replace(scene, views=(scene.views[0], other))
    config = load_config("default", {"plan.enabled": False, "response.name": "linear"})
    with pytest.raises(SehdrError, match="no two training cameras"):
        train(two, tmp_path / "run", config, device="cpu")
