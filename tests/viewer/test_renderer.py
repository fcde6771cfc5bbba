"""The order in which the viewer's pictures are made."""

import threading
import time
from functools import partial

import pytest

from sehdr_warp.viewer.renderer import Renderer


def test_small_pictures_go_first_and_large_ones_get_their_turn():
    renderer, begun, order = Renderer(), threading.Event(), []
    threads = [threading.Thread(target=renderer.call, args=(lambda: begun.wait(10),))]
    sizes = [4_000_000, 2_000_000, 100, 3_000_000]
    threads += [threading.Thread(target=renderer.call, args=(partial(order.append, size), size)) for size in sizes]
    for thread in threads:
        thread.start()
        time.sleep(0.02)
    begun.set()
    for thread in threads:
        thread.join(10)
    assert order == sorted(sizes)
    with pytest.raises(ZeroDivisionError):
        renderer.call(lambda: 1 / 0)
    renderer.close()
    with pytest.raises(RuntimeError, match="has ended"):
        renderer.call(list)


def test_a_small_picture_is_made_beside_a_large_one():
    renderer, begun, end = Renderer(second_thread=True), threading.Event(), threading.Event()

    def large():
        begun.set()
        assert end.wait(10)

    thread = threading.Thread(target=renderer.call, args=(large, 2_000_000))
    thread.start()
    assert begun.wait(10) and renderer.call(lambda: "small", 640 * 480) == "small"
    assert thread.is_alive(), "the small picture waited for the large one"
    end.set()
    thread.join(10)
    renderer.close()
