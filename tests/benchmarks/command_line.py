"""Command lines of `python -m benchmarks` in this process."""

import pytest

from benchmarks.__main__ import main


def call(*words) -> int | str | None:
    """Return the exit status of a command line."""
    with pytest.raises(SystemExit) as caught:
        main([str(word) for word in words])
    return caught.value.code


def refused(capfd, *words) -> str:
    """Return the error of a command line that must fail with status 1 and one line."""
    capfd.readouterr()
    assert call(*words, "-q") == 1
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("python -m benchmarks: "), lines
    return lines[0]
