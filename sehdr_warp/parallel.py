"""The number of threads, results that threads compute ahead, and waits that signals can end."""

import atexit
import logging
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import TypeVar

from .limits import processor_limit

Item = TypeVar("Item")
Result = TypeVar("Result")
WAITING_NOTICE = 5.0  # Seconds after which a wait is logged
_LOOK_EVERY = 0.1


def thread_count() -> int:
    """Return the threads to use on the CPU.

    SEHDR_THREADS if it is set, else the processors that this process may run on, and no more than the CPU quota of its
    container or batch job.
    """
    requested = os.environ.get("SEHDR_THREADS", "")
    if requested.isdigit() and int(requested) > 0:
        return int(requested)
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return min(count, processor_limit() or count)


def prefetch_map(function: Callable[[Item], Result], items: Iterable[Item], ahead: int) -> Iterator[Result]:
    """Yield function(item) for each item in order, computed ahead on threads.

    It is of use if the function releases the interpreter's lock, as decoding of images does.

    Args:
        function: what is computed. Its exception is raised when the item's result is due.
        items: the items.
        ahead: results that are computed or wait to be taken, at most.
    """
    ahead = min(ahead, thread_count())
    if ahead < 2:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(ahead, thread_name_prefix="sehdr-warp reads") as pool:
        waiting: deque = deque()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) >= ahead:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def run_interruptibly(function: Callable[[], Result], waiting: Callable[[], None] | None = None) -> Result:
    """Return function() while signals stay in force, for native code that does not return to Python for long.

    The main thread waits for another that runs it. If a signal ends the wait, the program must not outlast its main
    thread, so its end does not wait for the native code.

    Args:
        function: What takes long.
        waiting: Called once if it takes longer than WAITING_NOTICE seconds.
    """
    if threading.current_thread() is not threading.main_thread():
        return function()
    future: Future[Result] = Future()
    # Not the thread itself: Python 3.11 takes one for ended if a signal interrupts its join().
    ended = threading.Event()

    def run() -> None:
        try:
            future.set_result(function())
        except BaseException as error:  # noqa: BLE001 - It is raised where the result is waited for.
            future.set_exception(error)
        finally:
            ended.set()

    threading.Thread(target=run, name="sehdr-warp waits", daemon=True).start()
    started = time.monotonic()
    try:
        while not ended.wait(_LOOK_EVERY):
            if waiting is not None and time.monotonic() - started > WAITING_NOTICE:
                waiting()
                waiting = None
    except BaseException as error:
        leave_at_exit(error, ended)
        raise
    return future.result()


def leave_at_exit(error: BaseException, ended: threading.Event | None = None) -> None:
    """Let Python end at once after an error, without waiting for native code, unless `ended` is set by then."""
    code = 130 if isinstance(error, KeyboardInterrupt) else error.code if isinstance(error, SystemExit) else 1

    def leave() -> None:
        if ended is None or not ended.is_set():
            with suppress(Exception):
                logging.shutdown()
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code if isinstance(code, int) else 1)

    atexit.register(leave)


@contextmanager
def preserve_signals() -> Iterator[None]:
    """Put the program's signal handlers back after an import whose library installs its own."""
    yield
    if threading.current_thread() is threading.main_thread():
        for each in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(each)  # Python's own view, which the library did not change.
            if handler is not None:
                signal.signal(each, handler)
