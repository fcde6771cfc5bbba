"""What a training tells while it runs, and how often."""

import io

import pytest

from sehdr_warp.training import progress as module
from sehdr_warp.training.progress import Progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "cost", "interval"),
    [(Terminal, 0.001, 0.5), (Terminal, 0.1, 2.0), (Terminal, 5, 10), (io.StringIO, 5, 10)],
)
def test_reports_that_cost_more_come_less_often(stream, cost, interval, monkeypatch):
    now = 100.0
    monkeypatch.setattr(module.time, "monotonic", lambda: now)
    monkeypatch.setattr(module.sys, "stderr", stream())
    with Progress(100) as progress:
        assert progress.is_due(1)
        now += cost
        progress.update(1, loss=0.1, psnr=20.0, count=5, seconds_left=9.0)
        now += 0.99 * interval
        assert not progress.is_due(2)
        now += 0.02 * interval
        assert progress.is_due(3) and progress.is_due(100)
