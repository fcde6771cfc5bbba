"""The lock of a scene that several threads render and one at a time changes."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class SceneLock:
    """Lets several threads render a scene at the same time, or one thread change it; a change goes first."""

    def __init__(self) -> None:
        """Begin unlocked."""
        self._changed, self._rendering, self._changing = threading.Condition(), 0, False

    @contextmanager
    def rendering(self) -> Iterator[None]:
        """Wait until nobody changes the scene, and keep it as it is."""
        with self._changed:
            self._changed.wait_for(lambda: not self._changing)
            self._rendering += 1
        try:
            yield
        finally:
            with self._changed:
                self._rendering -= 1
                self._changed.notify_all()

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Wait until nobody renders or changes the scene, and keep others away from it."""
        self.block()
        try:
            yield
        finally:
            with self._changed:
                self._changing = False
                self._changed.notify_all()

    def block(self, timeout: float | None = None) -> None:
        """Wait until nobody renders or changes the scene, for at most `timeout` seconds, and let nobody begin."""
        with self._changed:
            self._changed.wait_for(lambda: not self._changing, timeout)
            self._changing = True
            self._changed.wait_for(lambda: not self._rendering, timeout)
