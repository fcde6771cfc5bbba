"""How far above white light is expected to be where photos clip."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.response import response_by_name
from sehdr_warp.scene import codes_of
from sehdr_warp.training.config import LossConfig
from sehdr_warp.training.config_files import load_config
from sehdr_warp.training.highlights import CHANNEL_PARTS, expected_excess, tail_stops
from sehdr_warp.training.train import train
from sehdr_warp.training.trainer import Trainer

from .toy import toy_field, toy_scene

PRIOR = LossConfig(highlight_weight=0.1, highlight_stops=2.0)


def views_of(*images):
    view = toy_scene(view_count=1).views[0]
    return [replace(view, codes=codes_of(np.asarray(image, np.float32)), hdr=None) for image in images]


def exponential_photo(response, stops, size=200, seed=0):
    """8-bit values of light whose stops above half of white are distributed exponentially with that mean."""
    excess = np.random.default_rng(seed).exponential(stops, (size, size, 3)) - 1
    return np.round(255 * response.encode(response.white * 2.0**excess)) / 255


@pytest.mark.parametrize("name", ["srgb", "camera", "linear"])
@pytest.mark.parametrize("stops", [0.7, 1.5, 3.0])
def test_a_known_tail_is_found(name, stops):
    response = response_by_name(name)
    # Rounding to codes moves the lower threshold by up to half a code.
    assert tail_stops(views_of(exponential_photo(response, stops)), response) == pytest.approx(stops, rel=0.05)


def test_the_longer_the_tail_the_more_is_expected_up_to_highlight_stops():
    response = response_by_name("srgb")
    found = [
        expected_excess(views_of(exponential_photo(response, stops)), response, PRIOR) for stops in (0.5, 1.0, 4.0)
    ]
    for (one, two, three), most in zip(found, (0.5, 1.0, 2.0), strict=True):
        assert three == pytest.approx(most, rel=0.05)
        assert (one, two) == pytest.approx((CHANNEL_PARTS[0] * three, CHANNEL_PARTS[1] * three))


def test_nothing_is_expected_where_nothing_clips_or_nothing_is_asked():
    response = response_by_name("srgb")
    dim = views_of(np.full((4, 4, 3), 250 / 255))
    assert tail_stops(dim, response) == 0 and expected_excess(dim, response, PRIOR) is None
    black = views_of(np.zeros((4, 4, 3)))
    assert tail_stops(black, response) == 0 and expected_excess(black, response, PRIOR) is None
    white = views_of(np.ones((4, 4, 3)))
    assert expected_excess(white, response, replace(PRIOR, highlight_weight=0.0)) is None
    # All clipped: no tail is seen, and the longest is assumed.
    assert tail_stops(white, response) == math.inf
    assert expected_excess(white, response, PRIOR) == pytest.approx([part * 2.0 for part in CHANNEL_PARTS])


def test_fixed_expects_the_same_everywhere_and_masks_take_no_part():
    response = response_by_name("srgb")
    (view,) = views_of(exponential_photo(response, 0.5, size=32))
    assert expected_excess([view], response, replace(PRIOR, highlight_expected="fixed")) == (2.0, 2.0, 2.0)
    assert tail_stops([replace(view, mask=np.zeros((32, 32), np.float32))], response) == 0
    image = view.image.copy()
    image[:, 16:] = 1.0
    left = replace(
        view, codes=codes_of(image), mask=np.repeat([[1.0, 0.0]], 16, axis=1).repeat(32, axis=0).astype(np.float32)
    )
    cut = replace(view, codes=view.codes[:, :16])
    assert (
        tail_stops([left], response) == tail_stops([cut], response) < tail_stops([replace(left, mask=None)], response)
    )


def clipped_scene(value=None):
    """The toy photos, exposed until much of them clips; or of one value everywhere."""
    scene = toy_scene()
    views = [
        np.minimum(view.image * 4, 1) if value is None else np.full_like(view.image, value) for view in scene.views
    ]
    return replace(
        scene, views=tuple(replace(v, codes=codes_of(i), hdr=None) for v, i in zip(scene.views, views, strict=True))
    )


def mean_excess(run, scene):
    """Mean stops over white of the rendered light where the training photos clip in all channels."""
    stops = []
    for view in scene.train_views:
        light = run.render(view.camera).hdr.numpy() * view.exposure_time / run.response.white
        stops.append(np.log2(np.maximum(light[(view.image == 1).all(axis=2)], 1e-6)).ravel())
    return float(np.concatenate(stops).mean())


def config_of(**fields):
    dotted = {"response.name": "srgb", "schedule.iterations": 400, "schedule.coarse_levels": 0, **fields}
    return load_config("demo", {"densification.strategy": "none", **dotted})


def test_a_training_lifts_clipped_light_as_far_as_is_expected(tmp_path):
    scene = clipped_scene()
    reached = []
    for stops in (0.3, 3.0):
        config = config_of(**{"loss.highlight_weight": 0.3, "loss.highlight_stops": stops})
        run = train(scene, tmp_path / f"{stops}", config, device="cpu", quiet=True)
        reached.append(mean_excess(run, scene))
    assert abs(reached[0] - 0.3) < 0.3 and reached[1] > 2.0


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_photos_of_one_value_stay_finite(value):
    trainer = Trainer(clipped_scene(value), config_of(**{"loss.highlight_weight": 0.1}), toy_field())
    for _ in range(10):
        trainer.step()
    assert trainer.skipped_steps == 0 and math.isfinite(trainer.loss)
    assert bool(torch.isfinite(trainer.field.gaussians.harmonics_dc).all())
