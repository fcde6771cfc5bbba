"""Progress of COLMAP, which reports none: rows of its database are counted while it works."""

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ...parallel import preserve_signals


@contextmanager
def counted_rows(database: Path, table: str, show: Callable[[int], None]) -> Iterator[None]:
    """Call show() with the rows of a table of COLMAP's database every half second while the block writes to it.

    Another process reads them: two copies of SQLite in one process, COLMAP's and Python's, break each other's locks.
    """
    with preserve_signals():
        import pycolmap
    words = (sys.executable, "-I", "-S", "-c", COUNT_ROWS, database.resolve().as_uri(), table)
    with ExitStack() as stack:
        stack.enter_context(pycolmap.Database.open(database))  # COLMAP waits for no lock; no later open needs one.
        try:
            counter = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        except OSError:  # As where no more processes may be started: the work goes on without.
            yield
            return

        def read() -> None:
            for line in counter.stdout or ():
                show(int(line))

        reader = threading.Thread(target=read, name="sehdr-warp counts", daemon=True)
        stack.enter_context(counter)
        reader.start()
        try:
            yield
        finally:
            counter.kill()
            reader.join()


COUNT_ROWS = """
import contextlib, sqlite3, sys, time
(place, table), count = sys.argv[1:], 0
while True:
    with contextlib.suppress(sqlite3.Error):
        with contextlib.closing(sqlite3.connect(place + "?mode=ro", uri=True, timeout=0.1)) as database:
            count = database.execute("SELECT COUNT(*) FROM " + table).fetchone()[0]
    print(count, flush=True)  # Even without news: it fails, and ends this process, if nobody reads any more.
    time.sleep(0.5)
"""
