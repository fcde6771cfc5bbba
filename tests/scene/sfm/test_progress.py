"""Counting what COLMAP has written so far, from another process."""

import subprocess
import sys
import time

import pycolmap

from sehdr_warp.scene.sfm import progress
from sehdr_warp.scene.sfm.progress import COUNT_ROWS, counted_rows


def test_rows_are_counted_while_they_are_written(tmp_path):
    path, counts = tmp_path / "a folder" / "database.db", []
    path.parent.mkdir()
    with counted_rows(path, "cameras", counts.append), pycolmap.Database.open(path) as database:
        for count in range(1, 4):
            database.write_camera(pycolmap.Camera.create_from_model_name(count, "PINHOLE", 10.0, 8, 6))
            deadline = time.monotonic() + 20
            while count not in counts and time.monotonic() < deadline:
                time.sleep(0.05)
            assert count in counts
    assert counts == sorted(counts)


def test_colmap_opens_its_database_while_rows_are_counted(tmp_path, monkeypatch):
    """COLMAP waits for no lock: a training failed where a count came in between."""
    monkeypatch.setattr(progress, "COUNT_ROWS", COUNT_ROWS.replace("time.sleep(0.5)", ""))
    with counted_rows(tmp_path / "database.db", "keypoints", lambda count: None):
        for _ in range(300):
            with pycolmap.Database.open(tmp_path / "database.db"):
                pass


def test_the_counter_ends_with_the_process_that_started_it(tmp_path):
    """Also if there is nothing to count yet."""
    words = [sys.executable, "-c", COUNT_ROWS, (tmp_path / "none.db").as_uri(), "keypoints"]
    counter = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert counter.stdout is not None
    assert counter.stdout.readline().strip() == b"0"
    counter.stdout.close()
    assert counter.wait(20) != 0
