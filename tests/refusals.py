"""A command line that must be refused: status 1, and one clear line on standard error."""

import pytest

from sehdr_warp import cli


def call(*arguments, main=cli.main):
    """Exit status of a command line in this process."""
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    return caught.value.code


def error_line(capfd, program="sehdr-warp") -> str:
    """The one line on standard error, native libraries' included."""
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith(f"{program}: ") and len(lines[0]) < 700, lines
    return lines[0]


def refused(capfd, *arguments, main=cli.main, program="sehdr-warp") -> str:
    """The error of a command line that must fail with status 1 and one line."""
    capfd.readouterr()
    assert call(*arguments, "-q", main=main) == 1
    return error_line(capfd, program)


def train_refused(capfd, data, *flags) -> str:
    out = data.parent / "run"
    line = refused(capfd, "train", data, "--out", out, "--device", "cpu", *flags)
    assert not out.exists()
    return line
