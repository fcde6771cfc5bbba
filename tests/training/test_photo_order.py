"""The order of photos: each once, alike on all ranks, the same after a resume."""

import pytest

from sehdr_warp.training.photo_order import PhotoOrder


def test_every_photo_comes_once_before_any_comes_again():
    order = PhotoOrder(5, seed=0)
    rounds = [[order.next() for _ in range(5)] for _ in range(3)]
    assert [sorted(photos) for photos in rounds] == [list(range(5))] * 3
    assert rounds[0] != rounds[1] or rounds[1] != rounds[2]
    other = PhotoOrder(5, seed=1)
    assert [[other.next() for _ in range(5)] for _ in range(3)] != rounds


def test_ranks_share_one_order():
    alone, ranks = PhotoOrder(7, seed=3), [PhotoOrder(7, 3, rank, 2) for rank in range(2)]
    for _ in range(10):
        assert [rank.next() for rank in ranks] == [alone.next(), alone.next()]


def test_what_follows_is_told_where_it_is_drawn():
    order = PhotoOrder(3, seed=0)
    assert order.peek() is None
    for _ in range(7):
        order.next()
        told = order.peek()
        state = order.state()
        assert told in (None, order.next())
        order.load_state(*state)


def test_an_order_goes_on_from_its_state():
    order, resumed = PhotoOrder(6, seed=2), PhotoOrder(6, seed=9)
    for _ in range(4):
        order.next()
    resumed.load_state(*order.state())
    assert [resumed.next() for _ in range(14)] == [order.next() for _ in range(14)]


@pytest.mark.parametrize("left", [[6], [-1]])
def test_photos_that_there_are_not_are_refused(left):
    order = PhotoOrder(6, seed=2)
    with pytest.raises(ValueError, match="names others than the 6 there are"):
        order.load_state(order.state()[0], left)
