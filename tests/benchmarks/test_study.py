"""Studies of benchmarks/ and priors/ as programs."""

import re
import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from benchmarks.study import run
from sehdr_warp.errors import SehdrError

ROOT = Path(__file__).parents[2]
STUDIES = sorted(
    f"{path.parent.name}.{path.stem}"
    for folder in ("benchmarks", "priors")
    for path in (ROOT / folder).glob("*.py")
    if re.search(r"^    run\(\w+\)$", path.read_text(), re.MULTILINE)
)


def ended(monkeypatch, main, *words):
    monkeypatch.setattr(sys, "argv", ["study.py", *words])
    # As `python -m` states it; processes of pytest-xdist have None.
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", ModuleSpec("benchmarks.study", None))
    with pytest.raises(SystemExit) as caught:
        run(main)
    return caught.value.code


@pytest.mark.parametrize("name", STUDIES)
def test_help_describes_every_option_and_does_nothing_else(name, monkeypatch, capsys):
    module = import_module(name)
    assert ended(monkeypatch, getattr(module, "main", None) or module.write_survey, "--help") == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert text.startswith("usage: python -m")
    assert not re.search(r"\(default: (None|False|)\)", text)
    assert not re.search(r"(PATH|INT|STR|FLOAT|\]) \((default|required)", text), "an option has no text"


def test_an_error_of_a_study_is_one_line(monkeypatch, capsys):
    def main(name: str, /) -> None:
        raise SehdrError(f"{name}: is not there; name another")

    assert ended(monkeypatch, main, "x") == 1
    assert re.fullmatch(r"python -m \S+: x: is not there; name another\n", capsys.readouterr().err)


def test_nothing_is_measured_for_a_file_that_may_not_be_replaced(monkeypatch, capsys, tmp_path):
    measured = []

    def main(json: Path) -> None:
        measured.append(json)

    own = tmp_path / "own.json"
    own.write_text("{}")
    assert ended(monkeypatch, main, "--json", str(own)) == 1 and not measured
    assert "never replaced" in capsys.readouterr().err
    assert ended(monkeypatch, main, "--json", str(tmp_path / "new.json")) == 0 and len(measured) == 1


def test_a_default_of_0_is_stated_and_none_is_not(monkeypatch, capsys):
    def main(seed: int = 0, limit: int | None = None) -> None:
        """Train.

        Args:
            seed: of the training.
            limit: photos.
        """

    assert ended(monkeypatch, main, "--help") == 0
    assert re.findall(r"\(default: .*?\)", capsys.readouterr().out) == ["(default: 0)"]
