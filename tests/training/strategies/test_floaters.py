"""Floaters: which Gaussians before the training cameras are relocated, and which stay."""

import numpy as np
import pytest
import torch

from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.runs.config import McmcConfig
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene import Camera, View, look_at
from sehdr_warp.training.strategies import TrainingCameras, distances_of_points, floaters, make_strategy


def view_from(position, target):
    """A photo of 40 by 40 pixels and 90 degrees."""
    camera = Camera(40, 40, 20.0, 20.0, 20.0, 20.0, look_at(position, target, (0, 1, 0)))
    return View("photo", np.zeros((40, 40, 3), np.uint8), camera, 1.0, "train")


def gaussians_at(means, widths, device):
    gaussians = Gaussians.from_points(torch.tensor(means), torch.ones(len(means), 3), 0).to(device)
    sizes = torch.tensor([[width, 0.01, 0.01] for width in widths], device=device)
    gaussians.overwrite({"log_scales": sizes.log(), "opacity_logits": torch.zeros(len(means), device=device)})
    return gaussians


def test_the_nearest_points_of_a_photo_are_those_in_its_view_without_mismatches():
    views = [view_from((0, 0, 0), (0, 0, 1)), view_from((0, 0, 0), (0, 0, -1))]
    behind = np.column_stack([np.zeros((20, 2)), np.full(20, -2.0)])
    before = np.column_stack([np.zeros((100, 2)), np.linspace(1, 10.9, 100)])
    seen_by_first, seen_by_second = distances_of_points(views, np.concatenate([behind, [[0, 0, 0.01]], before]))
    assert max(seen_by_first) == pytest.approx(1.1), "of 101 points the nearest two do not count"
    assert not any(seen_by_second), "20 points are too few"
    assert not np.any(distances_of_points(views, np.zeros((0, 3))))


def test_cells_of_a_photo_without_points_say_nothing_about_what_is_near():
    """A facade in the upper half of a photo, a few points of the lawn in a lower cell, and none in the others."""
    x, y = np.meshgrid(np.linspace(-9, 9, 40), np.linspace(1, 9, 20))
    facade = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 10.0)])
    lawn = np.column_stack([np.full(6, 0.1), np.full(6, -2.8), np.full(6, 3.0)])
    [distances] = distances_of_points([view_from((0, 0, 0), (0, 0, 1))], np.concatenate([facade, lawn]))
    cells = np.array(distances).reshape(floaters.CELLS, floaters.CELLS)
    assert (cells[:4] > 9.9).all() and cells[7, 3] == pytest.approx(4.1, abs=0.1)
    assert np.count_nonzero(cells[4:]) == 1


@pytest.mark.parametrize("share,expected", [(0.0, []), (0.5, [0, 4]), (1.0, [0, 3, 4])])
@pytest.mark.parametrize("at_once", [3, 1 << 24])
def test_what_is_nearer_to_a_photo_than_its_points_and_in_its_view_is_a_floater(
    device, share, expected, at_once, monkeypatch
):
    monkeypatch.setattr(floaters, "DISTANCES_AT_ONCE", at_once)
    views = [view_from((0, 0, 0), (0, 0, 1)), view_from((0, 0, 10), (0, 0, 20)), view_from((50, 0, 0), (51, 0, 0))]
    cameras = TrainingCameras.of_views(views, [4.0, 4.0, 0.0], device)
    # In view and near; as near, but beside the view and behind the camera; farther; near to the other two photos.
    means = [(0.5, 0.5, 1.8), (2.0, 0.0, 0.5), (0.0, 0.0, -0.5), (0.5, 0.5, 2.1), (0.0, 0.0, 11.0), (50.1, 0.0, 0.0)]
    gaussians = gaussians_at(means, [0.01] * 6, device)
    mask = floaters.floater_mask(gaussians, cameras, McmcConfig(prune_near_points=share))
    assert mask.nonzero()[:, 0].tolist() == expected


def test_only_cells_with_points_have_floaters(device):
    upper_half = [4.0] * 32 + [0.0] * 32
    cameras = TrainingCameras.of_views([view_from((0, 0, 0), (0, 0, 1))], [upper_half], device)
    gaussians = gaussians_at([(0.0, 0.5, 1.0), (0.0, -0.5, 1.0), (0.0, 0.5, 3.0)], [0.01] * 3, device)
    mask = floaters.floater_mask(gaussians, cameras, McmcConfig(prune_near_points=0.5))
    assert mask.tolist() == [True, False, False]


def test_cameras_that_find_no_floaters_take_no_time(device):
    views = [view_from((0, 0, 0), (0, 0, 1)), view_from((0, 0, 0), (0, 0, -1))]

    def cameras_of(distances, **options):
        values = {f"mcmc.{name}": value for name, value in options.items()}
        cameras = TrainingCameras.of_views(views, distances, device)
        return make_strategy(load_config("default", values), 10**6, cameras).cameras

    assert cameras_of([0.0, 0.0]) is None and cameras_of([1.0, 2.0], prune_near_points=0.0) is None
    assert cameras_of([0.0, 2.0]).nearest_points.unique().tolist() == [2]


def test_relocation_moves_what_veils_a_camera(device):
    views = [view_from((0, 0, 0), (0, 0, 1)), view_from((0, 0, 100), (0, 0, 200))]
    means = [(0.0, 0.0, z) for z in (0.9, 1.1, 2.0, 10.0, 50.0, 101.0, 104.0)]
    gaussians = gaussians_at(means, [0.25] * len(means), device)
    before = gaussians.means.detach().clone()
    options = {"mcmc.prune_near_points": 0.5, "mcmc.growth_rate": 0.0, "mcmc.seed_fraction": 0.0}
    cameras = TrainingCameras.of_views(views, [2.0, 6.0], device)
    strategy = make_strategy(load_config("default", options), 10**6, cameras)
    optimizer = torch.optim.Adam(gaussians.parameters())
    assert not strategy.refine(600, gaussians, optimizer, torch.Generator(device))
    # Nearer than 1 to the first camera, and than 3 to the second.
    moved = (gaussians.means.detach() != before).any(1)
    assert moved.tolist() == [True, False, False, False, False, True, False]
    assert set(map(tuple, gaussians.means[moved].tolist())) <= set(map(tuple, before[~moved].tolist()))
