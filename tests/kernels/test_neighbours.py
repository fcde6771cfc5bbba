"""Nearest neighbours against scipy's k-d tree, on clouds that break grids and growing radii."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree

from sehdr_warp.errors import SehdrError
from sehdr_warp.splatting.neighbours import nearest_neighbour_distances


def reference(points, k=3):
    points = points.astype(np.float64)
    distances = cKDTree(points).query(points, k=k + 1)[0].reshape(len(points), -1)
    # Among duplicates the tree may name another point first; the k + 1 smallest distances still begin with a zero.
    return distances[:, 1 : k + 1]


def clouds():
    rng = np.random.default_rng(7)
    uniform = rng.uniform(-1, 1, (3000, 3))
    cluster = rng.normal(0, 1e-3, (2000, 3))
    line = np.linspace(0, 1, 777)[:, None] * [[1.0, 2.0, -0.5]]
    grid = np.stack(np.meshgrid(*[np.arange(9.0)] * 3), -1).reshape(-1, 3)
    return {
        "uniform": uniform,
        "plane": uniform * [1, 1, 0],
        "collinear": line,
        "axis": line * [1, 0, 0],
        "grid": grid,
        "all the same": np.full((500, 3), 3.5),
        "duplicates": np.repeat(uniform[:400], 5, 0),
        "duplicates and others": np.concatenate([np.zeros((900, 3)), uniform[:300]]),
        "offset": uniform + 1e6,
        "clusters and outliers": np.concatenate([cluster, cluster + 50, uniform[:30] * 1e6]),
        "two scales": np.concatenate([cluster * 1e-6, uniform[:1000] * 1e3]),
        "tiny": uniform * 1e-30,
        "huge": uniform * 1e30,
        "shell": uniform / np.linalg.norm(uniform, axis=1, keepdims=True),
    }


@pytest.mark.parametrize("name", clouds())
def test_distances_equal_the_kd_tree(name, device):
    points = clouds()[name]
    found = nearest_neighbour_distances(torch.tensor(points, device=device)).cpu().numpy()
    np.testing.assert_allclose(found, reference(points), rtol=1e-12, atol=0)


@pytest.mark.parametrize("k", [1, 2, 8, 32])
def test_other_numbers_of_neighbours(k, device):
    points = np.random.default_rng(3).normal(size=(501, 3))
    found = nearest_neighbour_distances(torch.tensor(points, device=device), k).cpu().numpy()
    np.testing.assert_allclose(found, reference(points, k), rtol=1e-12)


def test_float32_points_far_from_the_origin(device):
    """Distances are those of the rounded coordinates, not worse."""
    points = (np.random.default_rng(5).uniform(-50, 50, (2000, 3)) + 1e6).astype(np.float32)
    found = nearest_neighbour_distances(torch.tensor(points, device=device))
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found.cpu().numpy(), reference(points), rtol=1e-6)


@settings(max_examples=60, deadline=None)
@given(arrays(np.float64, st.tuples(st.integers(5, 60), st.just(3)), elements=st.integers(-3, 3).map(float)))
def test_any_small_lattice_cloud(points):
    found = nearest_neighbour_distances(torch.tensor(points)).numpy()
    brute = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(brute, np.inf)
    np.testing.assert_allclose(found, np.sort(brute, 1)[:, :3], rtol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_missing_neighbours_are_infinitely_far(count, device):
    points = torch.arange(count * 3, dtype=torch.float32, device=device).reshape(count, 3)
    found = nearest_neighbour_distances(points, 3)
    assert found.shape == (count, 3)
    existing = max(count - 1, 0)
    assert torch.isfinite(found[:, :existing]).all() and torch.isinf(found[:, existing:]).all()


def test_a_large_cloud_with_every_difficulty(device):
    rng = np.random.default_rng(11)
    points = np.concatenate(
        [rng.normal(0, 1, (60000, 3)), rng.normal(0, 1e-4, (60000, 3)) + 7, rng.normal(0, 1e5, (500, 3))]
    )
    found = nearest_neighbour_distances(torch.tensor(points, device=device)).cpu().numpy()
    sample = rng.integers(0, len(points), 4000)
    expected = cKDTree(points).query(points[sample], k=4)[0][:, 1:]
    np.testing.assert_allclose(found[sample], expected, rtol=1e-11)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_named(value, device):
    points = torch.zeros(10, 3, device=device)
    points[4, 1] = value
    with pytest.raises(SehdrError, match="point 4 of 10"):
        nearest_neighbour_distances(points)


def test_wrong_arguments():
    with pytest.raises(ValueError, match="not \\[P, 3\\]"):
        nearest_neighbour_distances(torch.zeros(4, 2))
    with pytest.raises(TypeError, match="int64"):
        nearest_neighbour_distances(torch.zeros(4, 3, dtype=torch.int64))
    with pytest.raises(ValueError, match="k = 0"):
        nearest_neighbour_distances(torch.zeros(4, 3), 0)
