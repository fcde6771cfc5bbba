"""Warp's cache: what is damaged is found and goes, what is sound stays, and a place that cannot be used is no end."""

import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from sehdr_warp.rasterizer.warp_launch import kernel_cache


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(kernel_cache.atexit, "register", lambda *_, **__: None)
    for module in ("wp_blend_0a1b2c3", "wp_sort_0123456", "wp_sort_0123456_p1_t2"):
        (tmp_path / module).mkdir()
        for end in (".o", ".meta"):
            (tmp_path / module / f"{module}{end}").write_text(module + end)
    kernel_cache.discard_damaged()
    return tmp_path


def modules(cache):
    return sorted(path.name for path in cache.glob("wp_*"))


@pytest.mark.parametrize("damage", ["", "half", "wp_blend_0a1b2c3.O"])
@pytest.mark.parametrize("end", [".o", ".meta"])
def test_damaged_modules_go_and_are_logged_once(cache, caplog, damage, end):
    kernel_cache.discard_damaged()
    assert len(modules(cache)) == 3 and not caplog.text
    (cache / "wp_blend_0a1b2c3" / f"wp_blend_0a1b2c3{end}").write_text(damage)
    kernel_cache.discard_damaged()
    assert modules(cache) == ["wp_sort_0123456", "wp_sort_0123456_p1_t2"]
    kernel_cache.discard_damaged()
    assert caplog.text.count("1 damaged modules of the kernel cache are compiled again") == 1


@pytest.mark.parametrize("place", ["/dev/null", "/proc/none", "a\0b"])
def test_a_place_that_cannot_be_used_is_done_without(monkeypatch, caplog, place):
    folders = []
    monkeypatch.setattr(wp.config, "kernel_cache_dir", None)
    monkeypatch.setattr(kernel_cache.os, "environ", {"WARP_CACHE_PATH": place})
    monkeypatch.setattr(kernel_cache.atexit, "register", lambda *args, **_: folders.append(args[1]))
    kernel_cache.select_folder()
    assert folders == [wp.config.kernel_cache_dir] and "for this process alone" in caplog.text
    Path(folders[0]).rmdir()


END = """
import os, signal, sys
import warp as wp
from pathlib import Path
from sehdr_warp.process import prepare

wp.config.kernel_cache_dir = sys.argv[1] + "/empty"  # Not the user's: another test may compile into that meanwhile.
from sehdr_warp.rasterizer.warp_launch import kernel_cache

wp.config.kernel_cache_dir = sys.argv[1]
prepare()
kernel_cache.discard_damaged()
hash_line = kernel_cache.hash_line

def hashed(file, name):
    print("hashed", flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
    return hash_line(file, name)

kernel_cache.hash_line = hashed
(Path(sys.argv[1]) / "wp_blend_0a1b2c3" / "new.o").write_text("new")
"""


def test_a_signal_at_the_end_prints_nothing(cache):
    done = subprocess.run([sys.executable, "-c", END, cache], capture_output=True, text=True, timeout=120)
    assert done.stderr == "" and "hashed" in done.stdout


def test_files_are_read_at_the_end_only_if_something_was_compiled(cache, monkeypatch):
    ends, hashed = [], []
    monkeypatch.setattr(kernel_cache.atexit, "register", lambda *call: ends.append(call))
    kernel_cache.discard_damaged()
    ((end, *arguments),) = ends
    hash_line = kernel_cache.hash_line
    monkeypatch.setattr(kernel_cache, "hash_line", lambda *call: hashed.append(call) or hash_line(*call))
    end(*arguments)
    assert not hashed
    (cache / "wp_blend_0a1b2c3" / "new.o").write_text("new")
    end(*arguments)
    assert len(hashed) == 5
