"""Libraries that print past Python, kept silent where an exception or nothing at all says it better."""

import atexit
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Whatever is written to file descriptor 2 meanwhile is lost; exceptions pass."""
    try:
        kept = os.dup(2)
    except OSError:  # The program runs without a standard error: nothing to silence.
        yield
        return
    with open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
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
