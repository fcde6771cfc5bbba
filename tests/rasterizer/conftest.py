"""Fixtures of the tests of the rasterizer."""

import pytest

from sehdr_warp.rasterizer.cuda_graphs import cache

from .emulated_graphs import emulate
from .repeated_calls import DEVICE


@pytest.fixture
def no_graphs(monkeypatch):
    """No CUDA graphs of earlier calls. Without a GPU, emulates those of the test's calls."""
    cache.clear_graphs()
    if DEVICE == "cpu":
        emulate(monkeypatch)
    yield
    cache.clear_graphs()
