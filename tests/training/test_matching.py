"""Points matched between photos lie on what the photos show, and errors are where Gaussians are born."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.rasterizer.ops.plane_sweep import BORDER
from sehdr_warp.response import response_by_name
from sehdr_warp.training.initialization import make_matcher

from .wall_and_lamp import LAMP, WALL, wall_and_lamp

LINEAR = response_by_name("linear")


def matched(scene, device, count=700):
    matcher = make_matcher(scene, LINEAR, device)
    return matcher.match(matcher.pixels(count, np.random.default_rng(0)))


@pytest.mark.parametrize("times", [(1.0,), (1.0, 0.5, 0.7)], ids=["one exposure", "exposures that drift"])
def test_matched_points_lie_on_wall_and_lamp(device, times):
    matches = matched(wall_and_lamp(times), device)
    depth, white = matches.points[:, 2].cpu().numpy(), (matches.colors > 0.99).all(1).cpu().numpy()
    assert len(depth) > 280
    assert (np.abs(depth[~white] - WALL) < 0.1 * WALL).mean() > 0.9
    if len(times) == 1:
        assert white.sum() >= 3 and (np.abs(depth[white] - LAMP) < 0.1 * LAMP).mean() > 0.8
    np.testing.assert_allclose(matches.footprints.cpu(), depth / 70, rtol=1e-4)


def test_dark_photos_are_matched_as_bright_ones_are(device):
    """Photos of 16 bits at a sixteenth of their values; colors of the points stay those of the photos."""
    scene = wall_and_lamp()
    dark = replace(scene, views=tuple(replace(v, codes=v.codes.astype(np.uint16) * 16) for v in scene.views))
    bright, matches = matched(scene, device), matched(dark, device)
    assert len(matches.points) > 0.8 * len(bright.points)
    depth, colors = matches.points[:, 2].cpu().numpy(), matches.colors.cpu().numpy()
    wall = colors.max(1) < 0.05
    assert (np.abs(depth[wall] - WALL) < 0.1 * WALL).mean() > 0.9
    assert colors.max() == pytest.approx(255 * 16 / 65535, abs=0.004)


def test_points_that_mislead_do_no_harm(device):
    """Behind the cameras, all in one place, or far beyond: depths come from the photos."""
    scene, rng = wall_and_lamp(), np.random.default_rng(0)
    clouds = rng.normal(0, 1, (200, 3)) - [0, 0, 5], np.tile([0.0, 0.0, 3.0], (200, 1)), rng.normal(0, 9, (200, 3)) + 40
    for points in clouds:
        matches = matched(replace(scene, points=points, point_colors=np.full(points.shape, 0.5, np.float32)), device)
        depth = matches.points[:, 2]
        assert len(depth) > 190 and ((depth - WALL).abs() < 0.1 * WALL).float().mean() > 0.8


def test_pixels_repeat_and_avoid_borders_and_masks(device):
    scene = wall_and_lamp()
    mask = np.zeros((64, 64), np.float32)
    mask[:, 32:] = 1
    matcher = make_matcher(
        replace(scene, views=tuple(replace(view, mask=mask) for view in scene.views)), LINEAR, device
    )
    pixels, again = (matcher.pixels(500, np.random.default_rng(1)) for _ in range(2))
    assert torch.equal(pixels, again) and (pixels[:, 1] >= 32).all()
    assert pixels[:, 1:].min() >= BORDER and pixels[:, 1:].max() < 64 - BORDER
    assert 150 < len(pixels) < 500 and set(pixels[:, 0].tolist()) == set(range(9))
