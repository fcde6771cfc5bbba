"""Figures of the pages are measured by the commands that they print."""

import json

from benchmarks.measure import measure


def leaves(number, build="a", **more):
    result = {"machine": {"build": build}, "rows": [number], "checks": [], "notes": []} | more
    return f"printf '%s' '{json.dumps(result)}' > $out/{number}.json\n"


def test_results_of_a_page_are_joined(tmp_path):
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "9.json").write_text("of before")
    joined = measure({"command": leaves(1) + leaves(2, notes=["a word"])}, tmp_path / "page")
    assert joined["rows"] == [1, 2] and joined["notes"] == ["a word"]
    assert joined["command"].count("printf") == 2
