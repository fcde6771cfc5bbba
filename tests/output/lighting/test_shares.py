"""Shares of an environment map's light."""

import numpy as np
import pytest

from sehdr_warp.output.lighting.shares import light_shares


def test_shares_are_of_measured_clipped_and_filled_in_light():
    radiance, added = np.zeros((1, 4, 3)), np.zeros((1, 4, 3))
    radiance[0, 0], radiance[0, 1], added[0, 2] = 2.0, 10.0, 4.0
    clipped = np.array([[0.0, 0.5, 0.0, 1.0]])
    weight = np.array([[1.0, 1.0, 0.5, 1.0]])
    shares = light_shares(radiance, added, clipped, clipped * np.minimum(radiance.mean(2), 4), weight)
    # Light 2 and half of 10 are measured; of the other half 2 are below white; a pixel of half the size is filled in.
    parts = shares.measured, shares.bound, shares.estimated, shares.inpainted
    assert parts == pytest.approx((7 / 14, 2 / 14, 3 / 14, 2 / 14))
    lines = shares.table().splitlines()
    assert [line.split("%")[0].strip() for line in lines] == ["50.0", "14.3", "21.4", "14.3"]


def test_without_knowledge_of_clipping_the_table_does_not_claim_a_measurement():
    shares = light_shares(np.ones((2, 4, 3)), np.zeros((2, 4, 3)), None, None, np.ones((2, 4)))
    assert shares.measured == 1 and not shares.clipped_known
    assert shares.to_dict()["measured"] is None and shares.to_dict()["shown"] == 1
    assert "measured" not in shares.table() and "does not state" in shares.table()


def test_a_black_map_has_no_shares():
    shares = light_shares(np.zeros((2, 4, 3)), np.zeros((2, 4, 3)), np.zeros((2, 4)), np.zeros((2, 4)), np.ones((2, 4)))
    assert (shares.measured, shares.bound, shares.estimated, shares.inpainted) == (0, 0, 0, 0)
