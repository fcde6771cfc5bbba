"""Fixtures of the tests of the rasterizer."""

import pytest

from sehdr_warp.rasterizer import graph_cache

from .emulated_graphs import emulate
from .repeated_calls import DEVICE


@pytest.fixture
def no_graphs(monkeypatch):
    """No CUDA graphs of earlier calls. Without a GPU, emulates those of the test's calls."""
    graph_cache.clear_graphs()
    if DEVICE == "cpu":
        emulate(monkeypatch)
    yield
    graph_cache.clear_graphs()
