"""Work that threads do ahead."""

import subprocess
import sys
import threading
import time

import pytest

from sehdr_warp import parallel
from sehdr_warp.parallel import prefetch_map, run_interruptibly, thread_count


@pytest.mark.parametrize("threads", ["1", "3"])
def test_order_is_kept_and_at_most_ahead_are_computed(monkeypatch, threads):
    monkeypatch.setenv("SEHDR_THREADS", threads)
    assert thread_count() == int(threads)
    begun, first_may_end = [], threading.Event()

    def make(item):
        begun.append(item)
        if item == 0 and threads != "1":
            assert first_may_end.wait(10)
        elif len(begun) == 3:
            first_may_end.set()
        return item * item

    results = prefetch_map(make, range(8), 3)
    assert next(results) == 0
    assert len(begun) <= int(threads)
    assert list(results) == [item * item for item in range(1, 8)]


def test_an_exception_comes_where_its_turn_is(monkeypatch):
    monkeypatch.setenv("SEHDR_THREADS", "4")
    results = prefetch_map(lambda item: 1 / item, [1, 2, 0, 4], 4)
    assert [next(results), next(results)] == [1, 0.5]
    with pytest.raises(ZeroDivisionError):
        next(results)


WAITS = """
import atexit, ctypes, os, signal, sys, threading, time
from sehdr_warp.parallel import run_interruptibly
from sehdr_warp.process import prepare
signal.signal(getattr(signal, sys.argv[1]), signal.SIG_DFL)  # nohup has SIGHUP ignored.
prepare()
atexit.register(print, "Python ends while native code runs")
threading.Timer(0.3, lambda: os.kill(os.getpid(), getattr(signal, sys.argv[1]))).start()
run_interruptibly(lambda: ctypes.CDLL(None).sleep(60), lambda: None)
print("went on")
"""


@pytest.mark.parametrize("name, code", [("SIGTERM", 143), ("SIGHUP", 129)])
def test_signals_end_a_wait_for_native_code(name, code):
    started = time.monotonic()
    done = subprocess.run([sys.executable, "-c", WAITS, name], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "") and time.monotonic() - started < 30


def test_a_wait_gives_the_result_or_raises(monkeypatch):
    monkeypatch.setattr(parallel, "WAITING_NOTICE", 0.15)
    notices = []
    assert run_interruptibly(lambda: time.sleep(0.5) or 7, lambda: notices.append(1)) == 7 and notices == [1]
    with pytest.raises(ZeroDivisionError):
        run_interruptibly(lambda: 1 / 0)


IMPORTS = """
import os, signal, sys
from sehdr_warp.process import prepare
prepare()
from sehdr_warp.scene.sfm.reconstruction import quiet_colmap
with quiet_colmap():
    os.kill(os.getpid(), signal.SIGTERM)
"""


def test_a_library_does_not_take_the_signals():
    pytest.importorskip("pycolmap")
    done = subprocess.run([sys.executable, "-c", IMPORTS], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (143, "")
