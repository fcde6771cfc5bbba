"""`sehdr-warp check`: what it writes and how it fails."""

import json

from sehdr_warp.check import splat_cases
from sehdr_warp.check.case import Case, Reading
from tests.refusals import call, refused


def test_every_bound_holds_and_is_written(tmp_path, capfd):
    path = tmp_path / "check.json"
    assert call("check", "--device", "cpu", "--json", path) == 0
    result = json.loads(path.read_text())
    assert len(result["rows"]) >= 24 and all(row["holds"] for row in result["rows"])
    assert all({"quantity", "error", "bound", "holds"} == {*r} for row in result["rows"] for r in row["readings"])
    assert result["machine"]["cpu"] and result["benchmark"] == "check"
    assert f"{len(result['rows'])} cases, " in capfd.readouterr().out
    assert "exists already" in refused(capfd, "check", "--device", "cpu", "--json", path)


def test_a_broken_bound_is_written_and_fails(tmp_path, capfd, monkeypatch):
    broken = Case("broken", "fails", lambda device: [Reading("error", float("nan"), 1e-6)])
    monkeypatch.setattr(splat_cases, "SPLAT_CASES", (broken,))
    monkeypatch.setattr(splat_cases, "POISON_CASES", ())
    line = refused(capfd, "check", "--device", "cpu", "--json", tmp_path / "failed.json")
    assert "1 of 1 cases exceed their bounds on cpu: broken" in line
    assert [row["holds"] for row in json.loads((tmp_path / "failed.json").read_text())["rows"]] == [False]


def test_old_options_name_what_replaces_them(capfd):
    assert call("check", "--quick") == 2
    assert "--quick is gone: every check is quick now" in capfd.readouterr().err
