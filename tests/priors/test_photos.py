"""Simulated photos of the prior's training: what clips has its truth, and a seed gives the same photos."""

import numpy as np
import pytest
import torch

from priors.pack import curves
from priors.panoramas import Pack, from_rgbe, listed_sources, to_rgbe
from priors.photos import Camera


@pytest.fixture
def pack(tmp_path):
    rng = np.random.default_rng(0)
    panoramas = np.float32(rng.lognormal(0, 1.5, (2, 32, 64, 3)))
    panoramas[:, 8:11, 20:24] = 400.0
    rooms = np.float32(rng.lognormal(0, 1, (3, 2, 40, 40, 3)))
    return Pack(panoramas, np.array([False, True]), ["a", "b"], rooms, curves(tmp_path / "none.mat"))


def test_clipped_values_are_above_white_and_others_are_decoded(pack):
    photos = Camera(pack, "cpu", np.array([0]), rooms=False, seed=3).take(12, 64, plain=True)
    clipped = photos.clipped > 0
    assert clipped.flatten(1).any(1).all() and not clipped.flatten(1).all(1).any()
    assert (photos.truth[~clipped] == 0).all() and photos.truth[clipped].max() > 1
    # Half a code of white is all that a clipped value may lack.
    assert photos.exposure[clipped].min() > 0.98 and photos.exposure[~clipped].max() < 1


@pytest.mark.parametrize("plain", [False, True])
def test_a_seed_gives_the_same_photos_and_another_gives_others(pack, plain):
    first, again, other = (
        Camera(pack, "cpu", np.array([0, 1]), rooms=True, seed=seed).take(6, 64, plain=plain) for seed in (1, 1, 2)
    )
    for name in ("exposure", "clipped", "truth"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert not torch.equal(first.exposure, other.exposure)


def test_rgbe_keeps_radiance_to_a_percent():
    radiance = np.float32(10.0 ** np.random.default_rng(0).uniform(-4, 4, (50, 1)) * [1.0, 0.8, 0.6])
    np.testing.assert_allclose(from_rgbe(to_rgbe(radiance)), radiance, rtol=0.01)
    assert (from_rgbe(to_rgbe(np.zeros((2, 3), np.float32))) == 0).all()


def test_every_source_has_a_licence_and_some_are_held_out():
    sources = listed_sources()
    assert len({source.name for source in sources}) == len(sources) == 46
    assert sum(source.held_out for source in sources) == 10


def test_brighter_lamps_are_brighter_where_they_clip_alone(pack):
    usual, stretched = (
        Camera(pack, "cpu", np.array([0]), rooms=False, seed=5, stretch_share=share).take(8, 64) for share in (0.0, 1.0)
    )
    lamps = (usual.truth > 1) & (stretched.clipped > 0)
    assert lamps.any() and (stretched.truth[lamps] > usual.truth[lamps]).float().mean() > 0.95
    assert stretched.truth.max() <= 2.2 * usual.truth.max()
    # A channel below white may clip with its lamp, never the other way around.
    assert (stretched.clipped >= usual.clipped).float().mean() > 0.999
