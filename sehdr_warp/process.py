"""The process of a command line: its signals, its standard streams, its locale and working directory.

A failed write to standard error is ignored, because messages about the work must not end the work. A failed write to
standard output is an error of one line, because the user asked for that output.
"""

import ctypes
import gc
import io
import os
import signal
import sys
import threading
import time
import warnings
from contextlib import suppress
from types import FrameType
from typing import Any, TextIO

from .errors import SehdrError

_SOON = 3.0  # Seconds within which another Ctrl-C says nothing new
_LIBRARIES = 400_000  # Objects of torch's and Warp's modules, about
_MMAP_THRESHOLD = -3  # M_MMAP_THRESHOLD of malloc.h
_IMPORTS = "<frozen importlib._bootstrap>"  # File of the frames of an import
_POOLS = os.path.join("concurrent", "futures", "thread.py")  # Of those of a thread pool
LONGEST_IMPORT = 10.0  # Seconds that a signal waits for an import, before it ends the process as it is
_LOOK_EVERY = 0.02
_interrupted = -_SOON
_resender: threading.Thread | None = None
_collects_late = False


class _Stream:
    """A standard stream that leads nowhere once it has failed. required: a failure is an error, else it is ignored."""

    def __init__(self, stream: TextIO, number: int, required: bool):
        self._stream, self._number, self._required = stream, number, required

    def write(self, text: str) -> int:
        self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._attempt(self._stream.flush)

    def _attempt(self, do, *arguments) -> None:
        try:
            do(*arguments)
        except (OSError, ValueError) as error:
            _lead_nowhere(self._number, os.O_WRONLY)
            if self._required and isinstance(error, BrokenPipeError):
                raise
            if self._required:
                reason = getattr(error, "strerror", None) or error
                raise SehdrError(f"standard output cannot be written ({reason}); send it elsewhere") from None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def prepare() -> None:
    """Install the signal handlers, and make the standard streams safe."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:  # The next file that is opened would take its number. A write of results must still fail.
            _lead_nowhere(number, os.O_WRONLY if name == "stderr" else os.O_RDONLY)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False))
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
        setattr(sys, ("stdout", "stderr")[number - 1], _Stream(stream, number, required=number == 1))
    collect_late()
    warnings.filterwarnings("ignore", module=r"PIL\.")  # Of damaged metadata: photos that cannot be used are named.
    os.environ["MPLBACKEND"] = "agg"  # Pictures go to files, whatever a shell was set up for.
    for each, handler in (("SIGINT", _interrupt), ("SIGTERM", _end), ("SIGHUP", _end)):
        number = getattr(signal, each, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:  # As nohup asks.
            signal.signal(number, handler)
    hook, thread_hook = sys.unraisablehook, threading.excepthook
    sys.unraisablehook = lambda event: None if is_interrupted() else hook(event)
    threading.excepthook = lambda event: None if is_interrupted() else thread_hook(event)


def use_utf8() -> None:
    """Start this program again in Python's UTF-8 mode if the locale has another encoding.

    Names of files are UTF-8 almost everywhere, whatever the locale says, and libraries take them for UTF-8.
    """
    if sys.getfilesystemencoding() != "utf-8" and not sys.flags.utf8_mode and os.environ.get("PYTHONUTF8") != "1":
        os.environ["PYTHONUTF8"] = "1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def check_working_directory() -> None:
    """Raise SehdrError if the working directory was deleted, in which native libraries fail to load."""
    try:
        os.getcwd()
    except OSError as error:
        raise SehdrError(f"the working directory cannot be used ({error.strerror}); cd to another") from None


def calm_threads() -> None:
    """Limit how long OpenMP's threads, torch's and ours, spin between launches; call it before torch is loaded.

    By default they spin so long that on a processor shared with other programs most of a training's time is spent so.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "FATAL")  # Its warnings of ranks end in lists of C++ functions.


def collect_late() -> None:
    """Postpone garbage collection until libraries are loaded, and exclude their objects from it.

    Libraries leave next to no garbage while they load, and looking for it takes a quarter of the time. Only for
    programs of our own, and once in a process.
    """
    global _collects_late
    if _collects_late:
        return
    _collects_late, usual = True, gc.get_threshold()

    def begin(*_) -> None:
        gc.callbacks.remove(begin)
        gc.set_threshold(*usual)
        gc.freeze()

    gc.callbacks.append(begin)
    gc.set_threshold(_LIBRARIES, *usual[1:])


def return_memory() -> None:
    """Make glibc return freed blocks of a megabyte and more to the system at once.

    By default it comes to keep blocks of up to 32 MB, and a server that makes pictures of many sizes grows by them.
    """
    with suppress(OSError, AttributeError):  # Another C library
        ctypes.CDLL(None).mallopt(_MMAP_THRESHOLD, 1 << 20)


def is_interrupted() -> bool:
    """Return whether Ctrl-C was pressed a moment ago: whatever is raised now may be its effect."""
    return time.monotonic() - _interrupted < _SOON


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, unless it was raised a moment ago or has to wait (_postpone)."""
    global _interrupted
    if not is_interrupted() and not _postpone(number, frame):
        _interrupted = time.monotonic()
        raise KeyboardInterrupt


def _end(number: int, frame: FrameType | None) -> None:
    """Raise SystemExit, unless it has to wait (_postpone)."""
    if not _postpone(number, frame):
        raise SystemExit(128 + number)


def _postpone(number: int, frame: FrameType | None) -> bool:
    """Return whether what `frame` does must be completed first; the signal then comes again.

    An exception in the middle of an import can be lost, because native code clears it (torch does while it imports
    NumPy), and leaves half a module, which fails later. A thread that a pool is just starting would be forgotten, and
    the end of the process would wait for it forever.
    """
    global _resender
    if not _must_complete(frame):
        return False
    if _resender is None or not _resender.is_alive():
        _resender = threading.Thread(target=_resend, args=(number,), name="sehdr-warp signal", daemon=True)
        try:
            _resender.start()
        except RuntimeError:  # No thread can be started: better now than never.
            return False
    return True


def _must_complete(frame: FrameType | None) -> bool:
    """Return whether a frame, or one that called it, imports a module or gives work to a thread pool."""
    while frame is not None:
        code = frame.f_code
        if code.co_filename == _IMPORTS or (code.co_name == "submit" and code.co_filename.endswith(_POOLS)):
            return True
        frame = frame.f_back
    return False


def _resend(number: int) -> None:
    """Send a signal to the main thread when it may end, or end the process after LONGEST_IMPORT seconds."""
    main = threading.main_thread().ident
    assert main is not None
    end = time.monotonic() + LONGEST_IMPORT
    while time.monotonic() < end:
        time.sleep(_LOOK_EVERY)
        if not _must_complete(sys._current_frames().get(main)):
            global _resender
            _resender = None  # The signal may come while the next module is imported, and has to wait again then.
            if hasattr(signal, "pthread_kill"):
                signal.pthread_kill(main, number)
            else:
                signal.raise_signal(number)
            return
    if number == signal.SIGINT:
        os.write(2, b"sehdr-warp: interrupted\n")
    os._exit(128 + number)


def _lead_nowhere(number: int, mode: int) -> None:
    handle = os.open(os.devnull, mode)
    if handle != number:
        os.dup2(handle, number)
        os.close(handle)
