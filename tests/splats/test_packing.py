"""Orders in space, codebooks, palettes and quaternions of compressed files."""

import numpy as np
import pytest

from sehdr_warp.splats.packing import (
    codebook,
    compact_order,
    from_smallest_three,
    logits,
    morton_order,
    palette,
    smallest_three,
)  # fmt: skip

RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize("order", [morton_order, compact_order])
def test_neighbors_of_an_order_are_near(order):
    means = RANDOM.uniform(-1, 1, (4096, 3))
    means[7] = 1e9  # A stray
    index = order(means)
    assert sorted(index) == list(range(4096))
    steps = np.linalg.norm(np.diff(means[index], axis=0), axis=1)
    assert np.median(steps) < 0.15 and order(means[:1]).tolist() == [0]


def test_a_codebook_ascends_and_its_nearest_level_is_the_code():
    values = np.concatenate([RANDOM.normal(size=5000), [40.0, -40.0]]).reshape(-1, 2)
    levels, codes = codebook(values)
    assert len(levels) == 256 and (np.diff(levels) >= 0).all() and codes.shape == values.shape
    error = np.abs(levels[codes] - values)
    np.testing.assert_allclose(error, np.abs(values[..., None] - levels).min(-1), atol=1e-6)
    assert error.max() < 0.4, "rare values count too"
    levels, codes = codebook(np.full((3, 1), 0.25))
    assert (levels[codes] == 0.25).all()


def test_a_palette_holds_few_rows_exactly_and_many_nearly():
    kinds = RANDOM.normal(size=(8, 5)).astype(np.float32)
    rows = kinds[RANDOM.integers(0, 8, 500)]
    centers, labels = palette(rows, 64)
    assert centers.shape == (64, 5)
    np.testing.assert_allclose(centers[labels], rows, atol=1e-5)
    rows = RANDOM.normal(size=(2000, 5)).astype(np.float32)
    centers, labels = palette(rows, 256)
    assert labels.max() < 256 and np.square(centers[labels] - rows).mean() < 0.25


def test_quaternions_by_three_components():
    quaternions = RANDOM.normal(size=(1000, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    largest, others = smallest_three(quaternions)
    assert np.abs(others).max() <= 1
    read = from_smallest_three(largest, others)
    np.testing.assert_allclose(np.abs((read * quaternions).sum(axis=1)), 1, atol=1e-6)


def test_opacities_of_0_and_1_are_finite_and_in_order():
    values = logits(np.arange(256) / 255)
    assert np.isfinite(values).all() and (np.diff(values) > 0).all()
    np.testing.assert_allclose(1 / (1 + np.exp(-values[1:-1])), np.arange(1, 255) / 255, rtol=1e-5)
