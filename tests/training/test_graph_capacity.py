"""Room for pairs: enough for what was seen, not much more, and mended where it was not."""

import pytest
import torch

from sehdr_warp.training.graph_capacity import KEPT, LEAST_ROOM, ROOM, GraphCapacity

MANY = 10 * LEAST_ROOM


def replay(room, pairs):
    """Recorded steps that need so many pairs each; the room that they were given."""
    for needed in pairs:
        given = room.capacity()
        overflow = torch.tensor(needed > given, device=room._needed.device)
        room.note(torch.tensor(needed, device=room._needed.device), overflow)
    return given


def test_room_follows_the_most_pairs_seen(device):
    room = GraphCapacity(device)
    assert not room.known
    room.launched(MANY)
    assert room.known
    most = MANY * 6 // 5
    assert replay(room, [MANY, most, MANY]) == ROOM * MANY
    assert not room.look()
    room.change(1.0)
    assert replay(room, [MANY] * 2) == ROOM * most
    room.change(1.1)
    assert replay(room, [MANY]) == pytest.approx(ROOM * KEPT * most, abs=3)
    room.change(2.5)
    assert replay(room, [MANY]) == pytest.approx(ROOM * 2.5 * MANY, abs=3)


def test_a_lack_of_room_is_noticed_and_mended(device):
    room = GraphCapacity(device)
    room.launched(MANY)
    replay(room, [MANY, 5 * MANY, MANY])
    assert room.lacked == 1
    assert room.look()
    assert replay(room, [5 * MANY]) == ROOM * 5 * MANY
    assert not room.look()


def test_few_pairs_get_the_least_room(device):
    room = GraphCapacity(device)
    room.launched(1)
    assert replay(room, [1]) == LEAST_ROOM
