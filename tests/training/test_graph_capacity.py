"""Room for pairs: enough for what was seen, not much more, and mended where it was not."""

import pytest
import torch

from sehdr_warp.rasterizer.training_step import judge_step
from sehdr_warp.training.graph_capacity import KEPT, LEAST_ROOM, ROOM, GraphCapacity

MANY = 10 * LEAST_ROOM


def replay(room, pairs):
    """Recorded steps that need so many pairs each; the room that they were given."""
    loss = torch.zeros((), device=room.tally.device)
    for needed in pairs:
        given, needed = room.capacity(), torch.tensor(needed, device=loss.device)
        judge_step(loss, loss[None], needed > given, room.tally, needed)
    return given


def test_room_follows_the_most_pairs_seen(device):
    room = GraphCapacity(device)
    assert not room.known
    room.launched(MANY)
    assert room.known
    most = MANY * 6 // 5
    assert replay(room, [MANY, most, MANY]) == ROOM * MANY
    assert room.look() == (0, False)
    assert not room.change(1.0, keep=False)
    assert replay(room, [MANY] * 2) == ROOM * most
    assert not room.change(1.1, keep=False)
    assert replay(room, [MANY]) == pytest.approx(ROOM * KEPT * most, abs=3)
    assert not room.change(2.5, keep=True)
    assert replay(room, [MANY]) == pytest.approx(ROOM * 2.5 * MANY, abs=3)


def test_a_lack_of_room_is_noticed_and_mended(device):
    room = GraphCapacity(device)
    room.launched(MANY)
    replay(room, [MANY, 5 * MANY, MANY])
    assert room.lacked == 1
    assert room.look() == (0, True)
    assert replay(room, [5 * MANY]) == ROOM * 5 * MANY
    assert room.look() == (0, False)


def test_room_stays_while_it_is_enough(device):
    room = GraphCapacity(device)
    room.launched(MANY)
    given = replay(room, [MANY])
    assert room.change(1.05, keep=True) and room.capacity() == given
    assert replay(room, [MANY * 21 // 20]) == given
    assert room.change(1.05, keep=True)
    replay(room, [MANY * 11 // 10])
    assert not room.change(1.1, keep=True)
    assert room.capacity() == pytest.approx(ROOM * 1.1 * 1.1 * MANY, abs=3)


def test_looks_that_do_not_wait_tell_what_the_one_before_asked_for(device):
    room, nan = GraphCapacity(device), torch.full((1,), float("nan"), device=device)
    room.launched(MANY)
    pairs = torch.tensor(5 * MANY, device=device)
    judge_step(nan[0], nan, pairs > room.capacity(), room.tally, pairs)
    late = [room.look(wait=False) for _ in range(2)]
    assert late[-1 if room.tally.is_cuda else 0] == (1, True)
    assert room.lacked == 1


def test_few_pairs_get_the_least_room(device):
    room = GraphCapacity(device)
    room.launched(1)
    assert replay(room, [1]) == LEAST_ROOM
