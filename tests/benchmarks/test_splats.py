"""Sizes of made-up scenes."""

import pytest

from benchmarks.splats import Size, parse_size
from sehdr_warp.errors import SehdrError


def test_sizes_are_read_and_reduced():
    assert parse_size("20k@200x100") == Size(20_000, 200, 100)
    assert parse_size("1M@1600x1200") == Size(1_000_000, 1600, 1200)
    assert Size(8000, 240, 160).reduced(2000) == Size(2000, 120, 80)
    for bad in ("tiny", "0@4x4", "5@4", "5@0x4", ""):
        with pytest.raises(SehdrError, match="not a size"):
            parse_size(bad)
