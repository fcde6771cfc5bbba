"""Room for pairs: enough for what was seen, not much more, and mended where it was not."""

import pytest
import torch

from sehdr_warp.training.pair_room import KEPT, LEAST_ROOM, ROOM_SEEN, ROOM_UNSEEN, PairRoom

MANY = 10 * LEAST_ROOM


def replay(room, pairs, photos=3):
    """Recorded steps that need so many pairs each; the room that they were given."""
    for needed in pairs:
        given = room.capacity(photos)
        overflow = torch.tensor(needed > given, device=room._needed.device)
        room.note(torch.tensor(needed, device=room._needed.device), overflow)
    return given


def test_room_shrinks_once_every_photo_was_seen(device):
    room = PairRoom(device)
    assert not room.known
    room.launched(MANY)
    assert room.known
    most = MANY * 7 // 5
    assert replay(room, [MANY, most, MANY]) == ROOM_UNSEEN * MANY
    assert not room.look()
    room.change(1.0)
    assert replay(room, [MANY] * 2) == ROOM_SEEN * most
    room.change(1.2)
    assert replay(room, [MANY]) == pytest.approx(ROOM_SEEN * KEPT * most, abs=3)
    room.change(2.5)
    assert replay(room, [MANY]) == pytest.approx(ROOM_SEEN * 2.5 * MANY, abs=3)


def test_a_lack_of_room_is_noticed_and_mended(device):
    room = PairRoom(device)
    room.launched(MANY)
    replay(room, [MANY, 5 * MANY, MANY])
    assert room.lacked == 1
    assert room.look()
    assert replay(room, [5 * MANY]) == ROOM_SEEN * 5 * MANY
    assert not room.look()


def test_photos_of_another_size_are_unseen(device):
    room = PairRoom(device)
    room.launched(MANY)
    replay(room, [MANY] * 9)
    room.resize()
    room.launched(4 * MANY)
    assert replay(room, [4 * MANY]) == ROOM_UNSEEN * 4 * MANY


def test_few_pairs_get_the_least_room(device):
    room = PairRoom(device)
    room.launched(1)
    assert replay(room, [1]) == LEAST_ROOM
