"""Libraries that print past Python, kept silent where an exception or nothing at all says it better."""

import atexit
import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress


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
    try:
        kept = os.dup(number)
    except OSError:  # The program runs without it: nothing to silence.
        yield
        return
    with open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), number)
    try:
        yield
    finally:
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
