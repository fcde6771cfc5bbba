"""Who may use a scene beside whom."""

import threading
from contextlib import ExitStack

from sehdr_warp.viewer.scene_lock import SceneLock


def test_several_render_and_one_changes_alone():
    lock, changed, rendered = SceneLock(), threading.Event(), threading.Event()

    def change():
        with lock.changing():
            changed.set()

    def render():
        with lock.rendering():
            rendered.set()

    with ExitStack() as stack:
        stack.enter_context(lock.rendering())
        threading.Thread(target=render).start()
        assert rendered.wait(10), "another thread renders beside"
        rendered.clear()
        changer = threading.Thread(target=change)
        changer.start()
        assert not changed.wait(0.1)
        threading.Thread(target=render).start()
        assert not rendered.wait(0.1), "who comes later waits for the change"
    assert changed.wait(10) and rendered.wait(10)
    changer.join(10)
    lock.block(timeout=1)
    threading.Thread(target=render, daemon=True).start()
    rendered.clear()
    assert not rendered.wait(0.1)
