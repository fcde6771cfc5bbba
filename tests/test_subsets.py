"""Every n-th of a sequence."""

import numpy as np
import pytest

from sehdr_warp.subsets import all_names, every_nth


@pytest.mark.parametrize(
    "count, most, left", [(0, 4, 0), (1, 4, 1), (4, 4, 4), (5, 4, 3), (9, 4, 3), (12, 4, 4), (1000, 24, 24)]
)
def test_every_nth_item_leaves_at_most_the_limit(count, most, left):
    subset = every_nth(range(count), most)
    assert len(subset) == left <= most and list(subset[:1]) == [0][:count]
    assert len(set(np.diff(subset))) <= 1


def test_all_names_are_listed_and_rows_of_neighbors_in_short():
    names = "abcdefghij"
    assert all_names(names, [0, 2, 3, 5, 6, 7, 9]) == "a, c, d, f to h, j"
    assert all_names(names, []) == ""
