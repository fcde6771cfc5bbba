"""Fields as flags."""

import pytest

from sehdr_warp.runs.config_flags import parse_field


@pytest.mark.parametrize(
    "path,text,value",
    [
        ("fusion.exposures", "1/8x, 1x", ("1/8x", "1x")),
        ("response.name", "201", "201"),
        ("schedule.evaluate_at", "100,200", (100, 200)),
        ("schedule.evaluate_at", "-1,2OO", (-1, "2OO")),
        ("loss.clipping", "false", False),
        ("loss.clipping", "perhaps", "perhaps"),
        ("optimizer.means", "1e-4", 1e-4),
        ("plan.keep", "", ()),
    ],
)
def test_values_of_flags(path, text, value):
    assert parse_field(path, text) == value
