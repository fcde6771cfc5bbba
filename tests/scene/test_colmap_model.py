"""Counting what COLMAP has written so far, from another process."""

import sqlite3
import subprocess
import sys
import time

from sehdr_warp.scene.colmap_model import COUNT_ROWS, counted_rows


def test_rows_are_counted_while_they_are_written(tmp_path):
    path, counts = tmp_path / "a folder" / "database.db", []
    path.parent.mkdir()
    with counted_rows(path, "keypoints", counts.append):
        database = sqlite3.connect(path)
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("CREATE TABLE keypoints (data BLOB)")
        for count in range(1, 4):
            database.execute("INSERT INTO keypoints VALUES (zeroblob(100000))")
            database.commit()
            deadline = time.monotonic() + 20
            while count not in counts and time.monotonic() < deadline:
                time.sleep(0.05)
            assert count in counts
    database.close()
    assert counts == sorted(counts)


def test_the_counter_ends_with_the_process_that_started_it(tmp_path):
    """Also if there is nothing to count yet."""
    words = [sys.executable, "-c", COUNT_ROWS, (tmp_path / "none.db").as_uri(), "keypoints"]
    counter = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert counter.stdout is not None
    assert counter.stdout.readline().strip() == b"0"
    counter.stdout.close()
    assert counter.wait(20) != 0
