"""Calls of rasterize() that CUDA graphs replay, and what they are compared with."""

import torch

from sehdr_warp.rasterizer import rasterize
from sehdr_warp.rasterizer.cuda_graphs import cache

from .scenes import random_scene, relative_error

DEVICE = "cuda:0" if torch.cuda.is_available() else "cpu"
CALLS = cache.WARMUP_CALLS + 3


def launched(*arguments, **options):
    """rasterize() with room for all pairs, which is never replayed."""
    return rasterize(*arguments, max_intersections=100_000, **options)


def scene_of(count=80, channels=3):
    return random_scene(count=count, channels=channels).to(torch.float32, DEVICE)


def recordings():
    return sum(size.captured for size in cache.pools.values())


def assert_alike(ours, truth):
    for mine, true in zip(ours, truth, strict=True):
        assert relative_error(mine, true) < 5e-5  # Without a GPU, two ways of blending.
