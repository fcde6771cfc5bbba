"""Photos of truth: the response, the quantisation, the noise and the ladder of exposure times."""

from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name
from sehdr_warp.synth.expose import SensorNoise, expose, exposure_ladder, noisy
from tests.make_scenes import load


@pytest.fixture(scope="module")
def room():
    return load("embedded", max_size=64)


@pytest.mark.parametrize("name", ["hdr-nerf", "srgb", "filmic"])
def test_photos_are_the_rounded_response_of_the_exposure(room, name):
    response = response_by_name(name)
    photographed = expose(room, response, 0.25)
    for before, view in zip(room.views, photographed.views, strict=True):
        assert view.exposure_time == 0.25 and view.image.dtype == np.float32
        np.testing.assert_array_equal(view.hdr, before.hdr)
        codes = view.image * 255
        np.testing.assert_allclose(codes, np.round(codes), atol=1e-4)
        assert np.abs(view.image - response.encode(before.hdr * 0.25)).max() <= 0.5 / 255 + 1e-5


def test_the_embedded_photos_come_back():
    room = load("embedded")
    again = expose(room, response_by_name("hdr-nerf"), 0.5)
    off = np.concatenate([np.abs(a.image - b.image).ravel() for a, b in zip(room.views, again.views, strict=True)])
    # The stored truth has half the bits of the one that was photographed.
    assert off.max() <= 1.001 / 255 and (off > 1e-4).mean() < 0.25


def test_noise_has_the_variance_of_photons_and_read_out():
    noise, white = SensorNoise(full_well=1000.0, read_noise=3.0), 4.0
    electrons = noisy(np.full((300, 300, 3), 0.2 * white), white, noise, np.random.default_rng(0)) / white * 1000.0
    assert abs(electrons.mean() - 200) < 0.5
    assert abs(electrons.var() / (200 + 9) - 1) < 0.03


def test_noise_saturates_repeats_and_differs_between_views_and_seeds(room):
    response, noise = response_by_name("srgb"), SensorNoise(500.0, 4.0)
    first, again, other = (expose(room, response, 1.0, noise=noise, seed=seed) for seed in (0, 0, 1))
    clean = expose(room, response, 1.0)
    np.testing.assert_array_equal(first.views[0].image, again.views[0].image)
    assert (first.views[0].image != other.views[0].image).any()
    assert max(view.image.max() for view in first.views) == 1.0
    overexposed = room.views[0].hdr > 1.5
    assert first.views[0].image[overexposed].mean() > 0.98 and (clean.views[0].image[overexposed] == 1).all()
    alone = expose(replace(room, views=room.views[3:5]), response, 1.0, noise=noise)
    np.testing.assert_array_equal(alone.views[0].image, first.views[3].image)


@pytest.mark.parametrize("name", ["hdr-nerf", "srgb"])
def test_the_ladder_stands_around_a_well_exposed_photo(room, name):
    response = response_by_name(name)
    times = exposure_ladder(room, response)
    np.testing.assert_allclose(np.divide(times[1:], times[:-1]), 4.0)

    def near_middle(time):
        images = np.stack([view.image for view in expose(room, response, time).train_views])
        return ((images > 0.25) & (images < 0.75)).mean()

    shares = [near_middle(time) for time in times]
    assert max(shares) == shares[2]
    assert 0.3 < np.median([view.image for view in expose(room, response, times[2]).train_views]) < 0.7


def test_what_cannot_be_exposed_is_refused(room):
    response = response_by_name("srgb")
    blind = replace(room, views=tuple(replace(view, hdr=None) for view in room.views))
    black = replace(room, views=tuple(replace(view, hdr=np.zeros_like(view.hdr)) for view in room.views))
    for call in (
        lambda: expose(blind, response, 1.0),
        lambda: exposure_ladder(blind, response),
        lambda: exposure_ladder(black, response),
        lambda: expose(room, response, 0.0),
        lambda: expose(room, response, float("nan")),
        lambda: SensorNoise(full_well=0.0),
        lambda: SensorNoise(read_noise=-1.0),
    ):
        with pytest.raises(InputError):
            call()
