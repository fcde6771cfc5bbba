"""`python -m benchmarks step` at a size that takes seconds."""

import json

from benchmarks import step

from .command_line import call


def test_step_times_whole_steps_and_checks_their_loss(tmp_path, capsys):
    command = ["step", "--device", "cpu", "--size", "400@40x32", "--repetitions", "3"]
    assert call(*command, "--preset", "default", "--json", tmp_path / "a.json") == 0
    result = json.loads((tmp_path / "a.json").read_text())
    (ours,) = result["rows"]
    assert (ours["implementation"], ours["preset"], ours["gaussians"]) == ("sehdr-warp", "default", 400)
    assert ours["amortized_steps"] == 100 and ours["gaussians_after"] <= 441
    assert [check["what"] for check in result["checks"]] == [
        "default: loss of step 1",
        f"default: loss of step {step.CHECKED_STEPS}",
    ]
    assert {check["against"] for check in result["checks"]} == {"plain torch"}
    assert "with densification" in capsys.readouterr().out
