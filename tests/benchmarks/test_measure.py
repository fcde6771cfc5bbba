"""What the pages show is measured by the commands that they print."""

import json

import pytest

from benchmarks.measure import measure
from benchmarks.report_pages import PAGES
from sehdr_warp.errors import SehdrError


def leaves(number, build="a", **more):
    result = {"machine": {"build": build}, "rows": [number], "checks": [], "notes": []} | more
    return f"printf '%s' '{json.dumps(result)}' > $out/{number}.json\n"


def test_results_of_a_page_are_joined(tmp_path):
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "9.json").write_text("of before")
    joined = measure({"command": leaves(1) + leaves(2, notes=["a word"])}, tmp_path / "page")
    assert joined["rows"] == [1, 2] and joined["notes"] == ["a word"]
    assert joined["command"].count("printf") == 2


@pytest.mark.parametrize("command", ["false\n" + leaves(1), "true", leaves(1) + leaves(2, "b")])
def test_half_a_page_is_none(tmp_path, command):
    with pytest.raises(SehdrError):
        measure({"command": command}, tmp_path / "page")


def test_commands_leave_results_where_they_are_looked_for():
    for name, page in PAGES.items():
        for line in page.get("command", "").replace("\\\n", " ").splitlines():
            assert "=" in line.split()[0] or "--json $out/" in line, name
