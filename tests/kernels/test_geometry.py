"""Ellipses at rectangles against many points in float64. Rotations are compared in test_project.py."""

import numpy as np
import pytest
import torch
import warp as wp

from sehdr_warp.kernels.geometry import geometry
from sehdr_warp.rasterizer.warp_launch.launching import launch


@pytest.mark.parametrize(("dtype", "scalar"), [(torch.float32, wp.float32), (torch.float64, wp.float64)])
def test_ellipses_meet_the_rectangles_that_their_points_are_in(device, dtype, scalar):
    g = geometry(scalar)
    meets, vec4s = g.ellipse_meets_rectangle, wp.array(dtype=g.vec4)

    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def meet(range_start: int, centers: vec4s, conics: vec4s, boxes: vec4s, results: wp.array(dtype=wp.bool)):
        i = range_start + wp.tid()
        box = boxes[i]
        results[i] = meets(centers[i], conics[i], box[0], box[1], box[2], box[3])

    rng = np.random.default_rng(0)
    count, cutoff = 400, 9.0
    centers, sizes = rng.uniform(-9, 9, (count, 2)), rng.uniform(0, 12, (count, 2))
    axes, turn = np.exp(rng.uniform(-2, 2, (count, 2, 1))), rng.uniform(0, np.pi, count)
    turn = np.stack([np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)], 1).reshape(-1, 2, 2)
    conics = np.linalg.inv(turn @ (axes**2 * turn.swapaxes(1, 2)))
    # The least of the form over a fine grid of the rectangle, which begins at the origin.
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 101)] * 2), -1).reshape(-1, 2)
    points = grid * sizes[:, None] - centers[:, None]
    form = np.einsum("npi,nij,npj->np", points, conics, points).min(1)
    sure = np.abs(form / cutoff - 1) > 0.05
    records = np.zeros((3, count, 4))
    records[0, :, :2], records[1, :, 3], records[2, :, 2:] = centers, cutoff, sizes
    records[1, :, :3] = conics.reshape(-1, 4)[:, [0, 1, 3]]
    results = torch.empty(count, dtype=torch.bool, device=device)
    launch(meet, count, *torch.tensor(records, dtype=dtype, device=device), results)
    assert 0.2 < (form < cutoff).mean() < 0.8 and sure.mean() > 0.9
    np.testing.assert_array_equal(results.cpu().numpy()[sure], (form < cutoff)[sure])
