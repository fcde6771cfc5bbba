import pytest
import tyro

from sehdr_warp.arguments import parse
from sehdr_warp.errors import UsageError
from sehdr_warp.output.commands import Render
from sehdr_warp.output.export.commands import Convert


def test_a_signal_while_flags_are_read_ends_the_program(monkeypatch):
    """It is no wrong usage: tyro printed nothing."""

    def interrupt(*_, **__):
        raise SystemExit(143)

    with pytest.raises(UsageError, match="more.ply"):
        parse(Convert, ["head.ply", "other.ply", "more.ply"], "sehdr-warp convert")
    monkeypatch.setattr(tyro, "cli", interrupt)
    with pytest.raises(SystemExit) as ended:
        parse(Convert, ["head.ply", "other.ply"], "sehdr-warp convert")
    assert ended.value.code == 143


def test_help_is_broken_by_the_terminal_alone(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "250")
    with pytest.raises(SystemExit):
        parse(Render, ["--help"], "sehdr-warp render")
    assert "normals, alpha, confidence, clipped, or all; the last three" in capsys.readouterr().out
