"""Tables of results."""

from benchmarks.results import markdown_table


def test_tables_leave_out_what_nothing_has_and_mark_what_one_lacks():
    rows = [{"a": 1.234, "b": "x", "c": None}, {"a": None, "b": "yy"}]
    assert markdown_table(rows, {"A=a": ".1f", "b": "", "c": "d"}) == "\n".join(
        ["|   A | b  |", "| --: | -- |", "| 1.2 | x  |", "|   - | yy |"]
    )
