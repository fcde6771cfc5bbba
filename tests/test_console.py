"""Progress and messages on the console while a training runs."""

import io
import logging
import math
import re
from types import SimpleNamespace

import pytest

from sehdr_warp import console
from sehdr_warp.progress import stage, track_progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Step(SimpleNamespace):
    """A step whose figures count how often they are read."""

    read = 0
    loss, gaussians, seconds_left, total = 0.04321, 50_123, 63.0, 300

    @property
    def psnr(self):
        Step.read += 1
        return 21.456


def steps(count):
    for i in range(1, count + 1):
        yield Step(iteration=i)
        if i == 2:
            logging.getLogger("sehdr_warp.training").info("held-out [psnr] 20 dB")


def printed(monkeypatch, stream, columns="80", level="info"):
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr(Step, "read", 0)
    console.show_logs(level)
    console.run_with_progress(steps(300), 300)
    return stream.getvalue()


@pytest.mark.parametrize(
    "columns,figures",
    [("60", "21.5 dB 50.1k"), ("80", "loss 0.043 21.5 dB"), ("120", "PSNR 21.46 dB  50.1k Gaussians")],
)
def test_a_terminal_has_a_bar_that_fits(columns, figures, monkeypatch):
    text = printed(monkeypatch, Terminal(), columns)
    assert "300/300" in text and "━" in text and "1:03 left" in text and "it/s" in text and figures in text
    assert "held-out [psnr] 20 dB\n" in text


def test_elsewhere_there_are_plain_lines(monkeypatch):
    text = printed(monkeypatch, io.StringIO())
    assert text.splitlines() == [
        "iteration 1/300, loss 0.0432, PSNR 21.46 dB, 50123 Gaussians, 1:03 left",
        "held-out [psnr] 20 dB",
        "iteration 300/300, loss 0.0432, PSNR 21.46 dB, 50123 Gaussians, 1:03 left",
    ]
    assert Step.read == 2, "figures are read where they are shown"


def test_quiet_is_quiet(monkeypatch):
    assert printed(monkeypatch, Terminal(), level="warning") == "" and Step.read == 0


def test_debug_names_the_logger(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr("sys.stderr", stream)
    console.show_logs("debug")
    logging.getLogger("sehdr_warp.scene").debug("a detail")
    assert stream.getvalue() == "sehdr_warp.scene: a detail\n"


def test_psnr_is_a_running_mean_of_photos_that_have_one(monkeypatch):
    values, stream, clock = iter([10.0, 20.0, 30.0, math.nan] * 100), io.StringIO(), iter(range(100_000))

    class Uneven(Step):
        psnr = property(lambda self: next(values))

    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock) / 10)
    console.show_logs()
    console.run_with_progress((Uneven(iteration=i) for i in range(1, 301)), 300)
    psnrs = [float(line.split("PSNR ")[1].split(" dB")[0]) for line in stream.getvalue().splitlines()]
    assert psnrs[0] == 10 and len(psnrs) > 2 and all(19 <= value <= 21 for value in psnrs[2:])


def test_a_stage_on_a_terminal_is_one_line(monkeypatch):
    stream = Terminal()
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setattr("sys.stderr", stream)
    console.show_logs()
    log = logging.getLogger("sehdr_warp.scene")
    with console.stages_on_terminal():
        for i, _ in track_progress("reading photos", range(40), log):
            if i == 20:
                log.info("a note")
        with stage("matching", 10, log) as matching:
            matching.later = 60.0
            matching.update(5)
    lines = [line for line in re.split(r"[\r\n]", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue())) if line]
    line_count = stream.getvalue().count("\n")
    assert "a note" in lines and lines[-1].startswith("matching") and "5/10" in lines[-1]
    assert line_count == 3, "one line for each stage, and the note above them"


def test_a_terminal_obeys_nothing_of_what_files_say(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    console.show_logs()
    logging.getLogger("sehdr_warp.scene").warning("photo %s", "a\x1b[2J\r\u202egpj\x9b Größe 写真")
    assert stream.getvalue() == "photo a\\x1b[2J\\x0d\\u202egpj\\x9b Größe 写真\n".replace("\\x0d", "\\r")


def test_messages_of_libraries_are_silenced():
    """Pillow tells of damaged photos, which the package names itself."""
    console.show_logs()
    assert not logging.getLogger("PIL.TiffImagePlugin").isEnabledFor(logging.ERROR)
