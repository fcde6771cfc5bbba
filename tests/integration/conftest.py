"""Data that tests of several modules share."""

import pytest

from ..make_scenes import write_colmap


@pytest.fixture
def data(tmp_path):
    """A COLMAP text set of 6 views, 64 x 48."""
    write_colmap(tmp_path / "data")
    return tmp_path / "data"
