"""What a person sees while a training runs."""

import io
import logging
from types import SimpleNamespace

import pytest

from sehdr_warp import console


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Step(SimpleNamespace):
    """A step whose figures count how often they are read."""

    read = 0
    loss, gaussians, seconds_left = 0.04321, 50_123, 63.0

    @property
    def psnr(self):
        Step.read += 1
        return 21.456


def steps(count):
    for i in range(1, count + 1):
        yield Step(iteration=i)
        if i == 2:
            logging.getLogger("sehdr_warp.training").info("held-out [psnr] 20 dB")


def told(monkeypatch, stream, columns="80", level="info"):
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr(Step, "read", 0)
    console.show_logs(level)
    console.follow(steps(300), 300)
    return stream.getvalue()


@pytest.mark.parametrize(
    "columns,figures",
    [("60", "21.5 dB 50.1k"), ("80", "loss 0.043 21.5 dB"), ("120", "PSNR 21.46 dB  50.1k Gaussians")],
)
def test_a_terminal_has_a_bar_that_fits(columns, figures, monkeypatch):
    text = told(monkeypatch, Terminal(), columns)
    assert "300/300" in text and "━" in text and "1:03 left" in text and "it/s" in text and figures in text
    assert "held-out [psnr] 20 dB\n" in text


def test_elsewhere_there_are_plain_lines(monkeypatch):
    text = told(monkeypatch, io.StringIO())
    assert text.splitlines() == [
        "iteration 1/300, loss 0.0432, PSNR 21.46 dB, 50123 Gaussians, 1:03 left",
        "held-out [psnr] 20 dB",
        "iteration 300/300, loss 0.0432, PSNR 21.46 dB, 50123 Gaussians, 1:03 left",
    ]
    assert Step.read == 2, "figures are read where they are shown"


def test_quiet_is_quiet(monkeypatch):
    assert told(monkeypatch, Terminal(), level="warning") == "" and Step.read == 0


def test_reports_that_cost_more_come_less_often(monkeypatch):
    now = iter(range(10_000))
    monkeypatch.setattr(console.time, "monotonic", lambda: next(now))
    told(monkeypatch, Terminal())
    # A second each time the clock is asked: a report costs one, and waits for the ten of the longest pause.
    assert 20 < Step.read < 40


def test_debug_names_the_logger(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr("sys.stderr", stream)
    console.show_logs("debug")
    logging.getLogger("sehdr_warp.scene").debug("a detail")
    assert stream.getvalue() == "sehdr_warp.scene: a detail\n"


@pytest.mark.parametrize("seconds,text", [(None, "-:--"), (5, "0:05"), (63.4, "1:03"), (3723, "1:02:03")])
def test_seconds(seconds, text):
    assert console.format_seconds(seconds) == text
