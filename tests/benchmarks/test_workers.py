"""`python -m benchmarks workers`: steps on threads, and on devices with a process each."""

import json

import pytest

from benchmarks import workers
from benchmarks.splats import Size

from .command_line import call


def test_threads_are_timed_and_give_one_loss(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("SEHDR_THREADS", "3")
    words = ["workers", "--device", "cpu", "--sizes", "300@40x32", "--repetitions", "1"]
    assert call(*words, "--json", tmp_path / "a.json") == 0
    result = json.loads((tmp_path / "a.json").read_text())
    assert [(row["kind"], row["workers"]) for row in result["rows"]] == [("threads", n) for n in (1, 2, 3)]
    assert result["rows"][0]["times_one"] == 1.0
    assert all(row["photo_ms"] > 0 for row in result["rows"])
    assert len({row["loss"] for row in result["rows"]}) == 1
    assert "loss on 3 threads" in result["checks"][-1]["what"]
    assert "| threads |" in capsys.readouterr().out


def test_a_loss_that_depends_on_the_threads_is_found(monkeypatch, capsys):
    right = workers.time_threads
    monkeypatch.setenv("SEHDR_THREADS", "2")
    monkeypatch.setattr(workers, "time_threads", lambda size, n, k: right(size, n, k) | {"loss": n / 7})
    assert call("workers", "--device", "cpu", "--sizes", "300@40x32", "--repetitions", "1") == 1
    assert "loss on 2 threads differs from one thread" in capsys.readouterr().err


@pytest.mark.parametrize("count", [1, 2])
def test_ranks_are_timed_by_photo(monkeypatch, count):
    for name in ("SEHDR_THREADS", "WORLD_SIZE"):
        monkeypatch.setenv(name, "1")
    if count == 1:  # In this process, whose libraries are loaded
        monkeypatch.setenv("SEHDR_RANKS", "")
        monkeypatch.setattr(workers.processes, "start_processes", lambda rank, arguments, *_, **__: rank(0, *arguments))
    timing = workers.time_ranks(Size(300, 40, 32), count, "cpu", 1)
    assert timing["photo_ms"] > 0 and timing["amortized_ms"] > 0
    assert timing["repetitions"] == workers.STEPS
