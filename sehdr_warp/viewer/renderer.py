"""The threads that make the viewer's pictures, and the order in which they do."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from itertools import count
from typing import Any, NamedTuple

_PIXELS_PER_SECOND = 1_000_000  # A picture waits as if it had been asked for later by its pixels over these
_SMALL = 640 * 480  # Pixels of a picture that need not wait for the end of a large one, which takes seconds on a CPU


class Renderer:
    """One thread for all pictures, because memory that libraries keep for each thread would add up.

    A small picture goes before large ones that wait, and these get their turn all the same. A second thread may make
    small pictures beside a large one.
    """

    def __init__(self, second_thread: bool = False) -> None:
        """Start the threads; second_thread: one more for small pictures, on a CPU, where a large one takes seconds."""
        self._waiting: list[_Picture] = []
        self._changed, self._closed, self._numbers = threading.Condition(), False, count()
        names = ["sehdr-warp viewer renders", *["sehdr-warp viewer renders small"] * second_thread]
        self._threads = [
            threading.Thread(target=self._run, args=(number > 0,), name=name, daemon=True)
            for number, name in enumerate(names)
        ]
        for thread in self._threads:
            thread.start()

    def call(self, make: Callable[[], Any], pixels: int = 0) -> Any:
        """Return what `make` returns on the thread; larger pictures, by their pixels, let smaller ones go first.

        Raises RuntimeError if the thread was ended, also while this waited.
        """
        future: Future[Any] = Future()
        with self._changed:
            if self._closed:
                raise RuntimeError("the renderer has ended")
            turn = time.monotonic() + pixels / _PIXELS_PER_SECOND
            self._waiting.append(_Picture(turn, next(self._numbers), pixels, future, make))
            self._changed.notify_all()
        return future.result()

    def close(self) -> None:
        """End the threads after the pictures that they make, and wait for them; those that wait are not made."""
        with self._changed:
            self._closed = True
            for picture in self._waiting:
                picture.future.set_exception(RuntimeError("the renderer has ended"))
            self._waiting.clear()
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _next_picture(self, small: bool) -> "_Picture | None":
        """Return the picture whose turn it is, among small pictures only if `small`; None if none waits."""
        fitting = [each for each in self._waiting if not small or 0 < each.pixels <= _SMALL]
        return min(fitting, default=None)

    def _run(self, small: bool) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._next_picture(small) or self._closed)
                if self._closed:
                    return
                picture = self._next_picture(small)
                assert picture is not None
                self._waiting.remove(picture)
            try:
                picture.future.set_result(picture.make())
            except BaseException as error:  # noqa: BLE001 - It is raised where the result is waited for.
                picture.future.set_exception(error)
            del picture


class _Picture(NamedTuple):
    """A picture that waits, in the order of the turns."""

    turn: float
    number: int
    pixels: int
    future: Future[Any]
    make: Callable[[], Any]
