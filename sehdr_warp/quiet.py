"""Silence libraries that print past Python, if an exception says it better or nothing needs to be said."""

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
    """Discard what is written to file descriptor 2 within the block; exceptions pass."""
    with _silent(2):
        yield


@contextmanager
def silent_output() -> Iterator[None]:
    """Discard what is written to descriptors 1 and 2 within the block, also what C streams buffer."""
    with _silent(1), _silent(2):
        try:
            yield
        finally:
            with suppress(Exception):  # Windows has no such library.
                ctypes.CDLL(None).fflush(None)


@contextmanager
def _silent(number: int) -> Iterator[None]:
    with _changing:
        users, original = _silenced.get(number, (0, None))
        if not users:
            with suppress(OSError):  # The program runs without it: nothing to silence.
                original = os.dup(number)
                with open(os.devnull, "wb") as nothing:
                    os.dup2(nothing.fileno(), number)
        _silenced[number] = users + 1, original
    try:
        yield
    finally:
        with _changing:
            users, original = _silenced[number]
            _silenced[number] = users - 1, original
            if users == 1 and original is not None:
                os.dup2(original, number)
                os.close(original)


def silence_exit() -> None:
    """Discard what is written to file descriptor 2 after the interpreter's end, if OpenImageIO is loaded then.

    colour-science loads it if it is installed, and it lists what Python still held.
    """
    atexit.unregister(_silence_openimageio)
    atexit.register(_silence_openimageio)


def _silence_openimageio() -> None:
    if "OpenImageIO" in sys.modules:
        sys.stderr.flush()
        with open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), 2)
