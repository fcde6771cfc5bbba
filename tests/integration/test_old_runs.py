"""Folders of runs that earlier versions wrote, which are stored in tests/data."""

from pathlib import Path

import pytest

from ..refusals import refused

DATA = Path(__file__).resolve().parents[1] / "data"


@pytest.mark.parametrize("command", ["render {run} --out {out}", "eval {run}", "train --resume --out {run}"])
def test_a_run_of_version_0_2_is_refused_with_what_to_do(command, tmp_path, capfd):
    words = command.format(run=DATA / "run-0.2", out=tmp_path / "views").split()
    line = refused(capfd, *words, "--device", "cpu")
    assert "of sehdr-warp 0.2.0" in line and "train again" in line
    assert not (tmp_path / "views").exists()
