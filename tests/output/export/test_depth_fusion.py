"""Depth of many views fused to distances, of a wall that is known."""

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.output.export.depth_fusion import DepthView, depth_views, fuse_depth, mesh_bounds, points_of_view
from sehdr_warp.output.world_transform import WorldTransform
from sehdr_warp.scene import Camera, look_at

from ..helpers import AnalyticRun, rendered_view


def wall(position) -> DepthView:
    """A view of the plane z = 0, red, from in front of it."""
    camera = Camera(64, 64, 60.0, 60.0, 32, 32, look_at(position, (0, 0, 0), up=(0, 1, 0)))
    y, x = np.indices((64, 64)).reshape(2, -1) + 0.5
    near, far = (camera.unproject(x, y, np.full(64 * 64, depth))[:, 2].reshape(64, 64) for depth in (1.0, 2.0))
    depth = 1 + near / (near - far)
    return DepthView(camera, torch.tensor(depth, dtype=torch.float32), torch.tensor([2.0, 0, 0]).expand(64, 64, 3))


def test_a_wall_is_at_its_place_and_outside_is_where_cameras_stand():
    views = [wall(place) for place in ((0, 0, 3), (1, 0, 3), (0, 1, 3))]
    assert np.abs(np.concatenate([points_of_view(view) for view in views])[:, 2]).max() < 1e-5
    low, high = mesh_bounds(views, None)
    assert low[2] < 0 < high[2] and high[0] - low[0] > 1
    distance, weight, light = fuse_depth(views, np.array([-0.2, -0.2, -0.5]), np.full(3, 0.02), (20, 20, 50))
    heights = -0.5 + 0.02 * np.arange(50)
    near = np.abs(heights) < 0.1
    assert (weight[..., near] == 3).all()
    np.testing.assert_allclose(distance[10, 10, near], heights[near] / 0.12, atol=0.05)
    assert (distance[..., heights > 0.2] == 1).all(), "in front"
    np.testing.assert_allclose(light[10, 10, np.abs(heights) < 0.03], [[2, 0, 0]] * 3, atol=1e-5)


def test_edges_and_thin_pixels_have_no_depth():
    class Step(AnalyticRun):
        def render(self, view):
            depth, alpha = np.full((view.height, view.width), 2.0), np.ones((view.height, view.width))
            depth[:, view.width // 2 :] = 3.0
            alpha[0] = 0.4
            return rendered_view(np.ones((view.height, view.width, 3)), alpha, depth)

    run = Step()
    [view] = depth_views(run, run.cameras[0].camera, WorldTransform.identity())
    half = view.depth.shape[1] // 2
    known = view.depth.numpy() > 0
    assert not known[:2].any() and not known[:, half - 1 : half + 1].any()
    assert (view.depth[2:, : half - 1] == 2).all() and (view.depth[2:, half + 1 :] == 3).all()
    with pytest.raises(SehdrError, match="no view shows a surface to mesh"):
        mesh_bounds([DepthView(view.camera, torch.zeros_like(view.depth), view.radiance)], None)
