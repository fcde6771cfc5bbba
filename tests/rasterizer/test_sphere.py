"""Caps of tiles; what pictures of the sphere show is compared in tests/kernels."""

import torch

from sehdr_warp.rasterizer.sphere import caps_of

from ..kernels.test_sphere import latlong


def test_caps_hold_their_directions():
    directions = latlong(50)
    for side in (16, 128):
        caps = caps_of(directions, side)
        columns = -(-50 // side)
        for y, x in ((0, 0), (24, 49), (13, 31)):
            cap = caps[(y // side) * columns + x // side]
            assert float(torch.dot(cap[:3], directions[y, x]).clamp(-1, 1).acos()) <= float(cap[3]) + 1e-9
