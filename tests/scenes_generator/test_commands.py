"""`python -m scenes.generator`, as typed."""

import pytest

from scenes.generator import render
from scenes.generator.__main__ import main


def refused(*arguments) -> str:
    """The one line of a command line that must fail."""
    with pytest.raises(SystemExit) as caught:
        main([str(argument) for argument in arguments])
    line = caught.value.code
    assert line.startswith("python -m scenes.generator: ") and "\n" not in line
    return line


def test_pack_says_what_it_costs(truth, tmp_path, capsys):
    folder, _, _ = truth
    main(["pack", str(folder), "--out", str(tmp_path / "small"), "--compression", "zip"])
    assert "mu-law" in capsys.readouterr().out
    assert "exists already" in refused("pack", folder, "--out", tmp_path / "small")
    assert "no finished set" in refused("pack", tmp_path, "--out", tmp_path / "other")


def test_render_refuses_in_a_line(tmp_path):
    assert "no such command" in refused("paint", "study")
    assert "take one of study" in refused("render", "castle", "--out", tmp_path)
    assert "--size 200" in refused("render", "study", "--out", tmp_path, "--size", "200")
    assert "--views" in refused("render", "study", "--out", tmp_path, "--views", "35")
    assert "--samples" in refused("render", "study", "--out", tmp_path, "--samples", "1")


def test_a_missing_renderer_is_named_with_its_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda name: None)
    assert "pip install mitsuba" in refused("render", "study", "--out", tmp_path)
    assert not any(tmp_path.iterdir())
