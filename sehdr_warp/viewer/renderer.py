"""The thread that makes the viewer's pictures, and the order in which it does."""

import heapq
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from itertools import count
from typing import Any

_PIXELS_PER_SECOND = 1_000_000
"""A picture waits as if it had been asked for later by its pixels over these."""


class Renderer:
    """One thread for all pictures, because memory that libraries keep for each thread would add up.

    A small picture goes before large ones that wait, and these get their turn all the same.
    """

    def __init__(self) -> None:
        """Start the thread."""
        self._waiting: list[tuple[float, int, Future[Any], Callable[[], Any]]] = []
        self._changed, self._closed, self._numbers = threading.Condition(), False, count()
        self._thread = threading.Thread(target=self._run, name="sehdr-warp viewer renders", daemon=True)
        self._thread.start()

    def call(self, make: Callable[[], Any], pixels: int = 0) -> Any:
        """Return what `make` returns on the thread.

        Args:
            make: What is done.
            pixels: Of the picture that it makes, by which others go first.

        Raises:
            RuntimeError: If the thread was ended, also while this waited.
        """
        future: Future[Any] = Future()
        with self._changed:
            if self._closed:
                raise RuntimeError("the renderer has ended")
            turn = time.monotonic() + pixels / _PIXELS_PER_SECOND
            heapq.heappush(self._waiting, (turn, next(self._numbers), future, make))
            self._changed.notify()
        return future.result()

    def close(self) -> None:
        """End the thread after the picture that it makes, and wait for it; those that wait are not made."""
        with self._changed:
            self._closed = True
            for _, _, future, _ in self._waiting:
                future.set_exception(RuntimeError("the renderer has ended"))
            self._waiting.clear()
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                _, _, future, make = heapq.heappop(self._waiting)
            try:
                future.set_result(make())
            except BaseException as error:  # noqa: BLE001 - It is raised where the result is waited for.
                future.set_exception(error)
            del future, make
