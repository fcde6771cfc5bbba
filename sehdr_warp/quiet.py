"""Libraries that print past Python, kept silent where an exception or nothing at all says it better."""

import atexit
import ctypes
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_changing = threading.Lock()
_silenced: dict[int, tuple[int, int | None]] = {}
"""Descriptors, with how many silence each now and where it leads otherwise: the first redirects, the last restores."""


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Whatever is written to file descriptor 2 meanwhile is lost; exceptions pass."""
    with _silent(2):
        yield


@contextmanager
def silent_output() -> Iterator[None]:
    """As silent_stderr, of descriptor 1 as well, and of what C's streams hold back until the end of the process."""
    with _silent(1), _silent(2):
        try:
            yield
        finally:
            with suppress(Exception):  # Windows has no such library.
                ctypes.CDLL(None).fflush(None)


@contextmanager
def _silent(number: int) -> Iterator[None]:
    with _changing:
        users, kept = _silenced.get(number, (0, None))
        if not users:
            with suppress(OSError):  # The program runs without it: nothing to silence.
                kept = os.dup(number)
                with open(os.devnull, "wb") as nothing:
                    os.dup2(nothing.fileno(), number)
        _silenced[number] = users + 1, kept
    try:
        yield
    finally:
        with _changing:
            users, kept = _silenced[number]
            _silenced[number] = users - 1, kept
            if users == 1 and kept is not None:
                os.dup2(kept, number)
                os.close(kept)


def silence_exit() -> None:
    """From the interpreter's end on nothing reaches file descriptor 2, where OpenImageIO is loaded: colour-science
    loads it if it is installed, and it lists, when Python has gone, what Python still held."""
    atexit.unregister(_silence_if_loaded)
    atexit.register(_silence_if_loaded, "OpenImageIO")


def _silence_if_loaded(module: str) -> None:
    if module in sys.modules:
        sys.stderr.flush()
        with open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), 2)
