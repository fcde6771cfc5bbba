"""Gaussians are born where a render does not explain its photo."""

import math
from dataclasses import replace

import numpy as np
import torch

from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.splats.arrays import HARMONIC_0
from sehdr_warp.training.initialization import make_field, make_matcher
from sehdr_warp.training.seeding import make_seeds
from sehdr_warp.training.training_views import ViewDataset

from .wall_and_lamp import LAMP, wall_and_lamp

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
