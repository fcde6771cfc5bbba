"""Batches of several families of photos."""

import numpy as np
import pytest
import torch

from priors import rooms
from priors.families import FAMILIES, Families


def test_a_batch_has_each_family_in_its_share_and_repeats_by_its_seed(pack, monkeypatch):
    monkeypatch.setattr(rooms, "PIXELS", 16)

    def batches(count):
        lit_rooms = rooms.LitRooms(2, "cpu", 0)
        families = Families(pack, "cpu", np.array([0]), rooms=True, seed=3, lit_rooms=lit_rooms)
        return families.take(count, 2, 64)

    first, again = batches(20), batches(20)
    assert [len(photos.truth) for photos in first] == [20, 20]
    assert all(torch.equal(a.truth, b.truth) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0].truth, first[1].truth)
    overexposed = first[0].clipped.amax(1).mean((1, 2))[7:10]
    assert overexposed.min() > 0.05 and sum(share for share, _ in FAMILIES.values()) == pytest.approx(1)
