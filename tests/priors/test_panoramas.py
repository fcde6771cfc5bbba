"""Panoramas as the pack holds them."""

import tomllib
from pathlib import Path

import numpy as np

from priors.panoramas import SOURCES, from_differences, from_rgbe, listed_sources, to_differences, to_rgbe


def test_rgbe_keeps_radiance_to_a_percent():
    radiance = np.float32(10.0 ** np.random.default_rng(0).uniform(-4, 4, (50, 1)) * [1.0, 0.8, 0.6])
    np.testing.assert_allclose(from_rgbe(to_rgbe(radiance)), radiance, rtol=0.01)
    assert (from_rgbe(to_rgbe(np.zeros((2, 3), np.float32))) == 0).all()


def test_differences_keep_every_byte():
    packed = np.random.default_rng(0).integers(0, 256, (3, 2, 8, 16, 4), dtype=np.uint8)
    np.testing.assert_array_equal(from_differences(to_differences(packed)), packed)


def test_some_sources_are_held_out_and_none_is_one_that_weights_are_checked_on():
    sources, listed = listed_sources(), tomllib.loads(SOURCES.read_text())
    assert len({source.name for source in sources}) == len(sources) == 107
    assert sum(source.held_out for source in sources) == len(listed["held_out"]) == 11
    assert not {Path(source.file).stem for source in sources} & {*listed["checked"], *listed["checked_more"]}
