"""Costs of the plane sweep against the same sums in float64 NumPy."""

import numpy as np
import pytest
import torch

from sehdr_warp.kernels.plane_sweep import sweep
from sehdr_warp.rasterizer.ops.plane_sweep import PhotoSet, matched_points, matching_costs, trusted_depths
from sehdr_warp.rasterizer.warp_launch.launching import launch
from sehdr_warp.scene import Camera
from sehdr_warp.scene.camera import look_at

SIZES = [(23, 17), (20, 20), (31, 12)]
NEIGHBORS = np.array([[1, 2], [0, 2], [0, -1]])


@pytest.fixture(scope="module")
def photos():
    rng = np.random.default_rng(0)
    cameras = [
        Camera(w, h, 20.0 + k, 21.0, w / 2, h / 2, look_at((0.3 * k, -0.1 * k, 0), (0.05 * k, 0, 3), (0, -1, 0)))
        for k, (w, h) in enumerate(SIZES)
    ]
    return [rng.integers(0, 256, (h, w, 3), dtype=np.uint8) for w, h in SIZES], cameras


def reference(images, cameras, pixel, depth) -> float:
    view, column, row = pixel
    own, costs = cameras[view], []
    window = [(x, y) for y in range(-2, 3) for x in range(-2, 3)]
    values = images[view].astype(float) / 255
    weights = [np.exp(-np.abs(values[row + y, column + x] - values[row, column]).mean() / 0.1) for x, y in window]
    for other in NEIGHBORS[view][NEIGHBORS[view] >= 0]:
        camera, other_image, total = cameras[other], images[other].astype(float) / 255, 0.0
        for (x, y), weight in zip(window, weights, strict=True):
            ray = [(column + x + 0.5 - own.cx) / own.fx, (row + y + 0.5 - own.cy) / own.fy, 1]
            world = own.camera_to_world @ np.append(np.multiply(ray, depth), 1)
            there = (camera.world_to_camera @ world)[:3]
            u, v = camera.fx * there[0] / there[2] + camera.cx - 0.5, camera.fy * there[1] / there[2] + camera.cy - 0.5
            if there[2] <= 0 or not (0 <= u < camera.width - 1 and 0 <= v < camera.height - 1):
                break
            left, top = int(u), int(v)
            a, b = u - left, v - top
            color = (1 - b) * ((1 - a) * other_image[top, left] + a * other_image[top, left + 1])
            color += b * ((1 - a) * other_image[top + 1, left] + a * other_image[top + 1, left + 1])
            total += weight * min(np.abs(color - values[row + y, column + x]).mean(), 0.25)
        else:
            costs.append(total / sum(weights))
    return float(np.mean(sorted(costs)[: max(2, (len(costs) + 1) // 2)])) if len(costs) > 1 else 0.5


def costs_by_threads(photo_set, pixels, depths):
    """matching_costs() as a GPU computes them, one thread a cost, on either device."""
    costs = torch.empty_like(depths)
    launch(sweep, depths.numel(), *vars(photo_set).values(), pixels, depths, costs)
    return costs


@pytest.mark.parametrize("costs_of", [matching_costs, costs_by_threads])
def test_costs_are_the_reference(photos, device, costs_of):
    images, cameras = photos
    pixels = [(0, 11, 8), (0, 4, 5), (0, 20, 14), (1, 10, 9), (1, 2, 2), (2, 15, 6)]
    depths = [0.4, 1.0, 2.0, 5.0, 40.0]
    expected = [[reference(images, cameras, pixel, depth) for depth in depths] for pixel in pixels]
    inputs = torch.tensor(pixels, dtype=torch.int32, device=device), torch.tensor(depths, device=device).repeat(6, 1)
    costs = costs_of(PhotoSet.of(images, cameras, NEIGHBORS, device), *inputs)
    np.testing.assert_allclose(costs.cpu(), expected, atol=2e-5)
    # Places that two neighbors see, and places that they do not, are both among them; the last view has one neighbor.
    assert 0.5 in costs[0] or 0.5 in costs[1]
    assert (costs[:5] < 0.5).any() and (costs[5] == 0.5).all()


@pytest.mark.parametrize("costs_of", [matching_costs, costs_by_threads])
@pytest.mark.parametrize("depth", [1e-30, 1e30, 3e38, float("inf"), float("nan"), 0.0, -1.0])
def test_impossible_depths_cost_what_is_not_seen(photos, device, depth, costs_of):
    photo_set = PhotoSet.of(*photos, NEIGHBORS, device)
    pixels = torch.tensor([[0, 11, 8]], dtype=torch.int32, device=device)
    cost = float(costs_of(photo_set, pixels, torch.full((1, 1), depth, device=device)))
    assert 0 <= cost <= 0.25 or cost == 0.5


TRUST = {"worst": 0.05, "margin": (1.3, 0.004), "few": 6, "widest": 1.2}


def trusted(costs, planes):
    """The depth of one row of costs, as the words of trusted_depths() have it."""
    best = int(costs.argmin())
    if not costs[best] < TRUST["worst"]:
        return 0.0
    close = np.flatnonzero(costs < TRUST["margin"][0] * costs[best] + TRUST["margin"][1])
    far, near = 1 / planes[close[0]], 1 / planes[close[-1]]
    if np.ptp(close) < TRUST["few"]:
        k = np.clip(best, 1, len(costs) - 2)
        a, b, c = costs[k - 1], costs[k], costs[k + 1]
        shift = np.clip(0.5 * (a - c) / max(a - 2 * b + c, 1e-6), -0.5, 0.5)
        return 1 / ((1 - abs(shift)) / planes[k] + abs(shift) / planes[k + (1 if shift > 0 else -1)])
    return 2 / (near + far) if near < TRUST["widest"] * far else 0.0


def test_depths_are_trusted_where_costs_are_sure(device):
    rng = np.random.default_rng(0)
    planes = 1 / np.linspace(1 / 9.0, 1 / 2.0, 40)
    costs = rng.uniform(0.06, 0.25, (600, 40))
    for row in costs:  # A valley in each, narrow or wide, at any place, of any depth.
        place, width = rng.integers(0, 40), rng.integers(1, 12)
        valley = slice(max(0, place - width), place + width)
        row[valley] = rng.choice([0.0, 0.02, 0.049, 0.055]) + 0.001 * (np.arange(40)[valley] - place) ** 2
    costs[0], costs[1] = 0.5, np.inf
    costs = costs.astype(np.float32)
    inputs = (torch.tensor(values, dtype=torch.float32, device=device) for values in (costs, planes))
    depth_values = trusted_depths(*inputs, **TRUST).cpu().numpy()
    expected = np.array([trusted(row, planes) for row in costs])
    assert 0.2 < (expected > 0).mean() < 0.9 and depth_values[0] == depth_values[1] == 0
    np.testing.assert_allclose(depth_values, expected, rtol=2e-3)


def test_matches_are_where_cameras_see_them(photos, device):
    images, cameras = photos
    inputs = PhotoSet.of(images, cameras, NEIGHBORS, device)
    poses = torch.tensor(np.stack([camera.camera_to_world for camera in cameras]), dtype=torch.float32, device=device)
    pixels = torch.tensor([[0, 9, 5], [2, 14, 7]], dtype=torch.int32, device=device)
    depths = torch.tensor([3.0, 0.7], device=device)
    points, colors, footprints = (values.cpu().numpy() for values in matched_points(inputs, poses, pixels, depths))
    for (view, column, row), depth, point, color, footprint in zip(
        pixels.tolist(), depths.tolist(), points, colors, footprints, strict=True
    ):
        camera = cameras[view]
        x, y, z = (camera.world_to_camera @ [*point, 1])[:3]
        fx, fy, cx, cy = camera.intrinsics
        np.testing.assert_allclose([fx * x / z + cx, fy * y / z + cy, z], [column + 0.5, row + 0.5, depth], rtol=1e-4)
        np.testing.assert_allclose(color, images[view][row, column] / 255, rtol=1e-6)
        np.testing.assert_allclose(footprint, depth / fx, rtol=1e-6)
