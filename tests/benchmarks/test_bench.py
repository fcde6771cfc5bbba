"""`python -m benchmarks kernels` and `step`, at sizes that take seconds."""

import json
import time
from itertools import pairwise

import pytest
import torch

from benchmarks import kernels, step
from benchmarks.results import markdown_table
from benchmarks.splats import Size, parse_size
from benchmarks.timing import Variant, time_variants
from sehdr_warp.errors import SehdrError

from .command_line import call, refused

KERNELS = ["kernels", "--device", "cpu", "--sizes", "200@40x33", "--repetitions", "3"]
CPU = torch.device("cpu")


def test_kernels_report_times_checks_and_machine(tmp_path, capsys):
    assert call(*KERNELS, "--channels", "3,4", "--json", tmp_path / "a.json") == 0
    result = json.loads((tmp_path / "a.json").read_text())
    assert (result["schema"], result["benchmark"]) == (2, "kernels")
    # The installed metadata may leave out the build that torch names, such as +cu130.
    assert torch.__version__.startswith(result["machine"]["versions"]["torch"].split("+")[0])
    table = capsys.readouterr().out
    assert "gsplat not compared: it needs CUDA" in table and "| rasterizer " in table
    assert {(row["channels"], row["pass"], row["implementation"]) for row in result["rows"]} == {
        (channels, passes, name)
        for channels in (3, 4)
        for passes in ("forward", "forward + backward")
        for name in ("sehdr-warp", "plain torch")
    }
    assert all(row["median_ms"] > 0 and row["repetitions"] == 3 for row in result["rows"])
    assert all(row["peak_memory_bytes"] >= 40 * 33 * row["channels"] * 4 for row in result["rows"])
    # Image and five gradients, for two channel counts.
    assert len(result["checks"]) == 2 * 6
    assert all(check["passed"] and check["difference"] < 1e-4 for check in result["checks"])


@pytest.mark.parametrize("gradient", [False, True])
def test_what_is_wrong_is_written_and_fails(gradient, tmp_path, monkeypatch, capsys):
    right = kernels.rasterize

    def wrong(means, log_scales, *rest, **options):
        if gradient:
            return right(means, 1.01 * log_scales - 0.01 * log_scales.detach(), *rest, **options)
        rendering = right(means, log_scales, *rest, **options)
        return type(rendering)(**{**vars(rendering), "image": rendering.image * 1.001})

    monkeypatch.setattr(kernels, "rasterize", wrong)
    assert call(*KERNELS, "--channels", "3", "--json", tmp_path / "a.json") == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    words = "gradient of log_scales" if gradient else "sehdr-warp: image"
    assert words in error and "do not use these times" in error
    assert not all(check["passed"] for check in json.loads((tmp_path / "a.json").read_text())["checks"])


def test_arguments_that_do_not_fit_are_named_before_anything_is_measured(tmp_path, capfd):
    (tmp_path / "a.json").write_text("mine")
    for arguments, message in (
        (["--json", tmp_path / "a.json"], "exists already"),
        (["--channels", "3,x"], "--channels 3,x: not whole numbers from 1"),
        (["--sizes", "9@9"], "size 9@9: not a size"),
        (["--repetitions", "0"], "--repetitions 0: not positive"),
    ):
        assert message in refused(capfd, "kernels", "--device", "cpu", *arguments)
    assert (tmp_path / "a.json").read_text() == "mine"


def test_sizes_are_read_and_reduced():
    assert parse_size("20k@200x100") == Size(20_000, 200, 100)
    assert parse_size("1M@1600x1200") == Size(1_000_000, 1600, 1200)
    assert Size(8000, 240, 160).reduced(2000) == Size(2000, 120, 80)
    for bad in ("tiny", "0@4x4", "5@4", "5@0x4", ""):
        with pytest.raises(SehdrError, match="not a size"):
            parse_size(bad)


def test_variants_take_turns_and_slow_ones_run_less_often():
    ran, prepared, seconds = [], [], {"fast": 0.0, "slow": 0.02}

    def variant(name):
        def run():
            assert prepared.pop() == name
            ran.append(name)
            time.sleep(seconds[name])

        return Variant(run, prepare=lambda: prepared.append(name))

    timings = time_variants({name: variant(name) for name in seconds}, CPU, repetitions=12, budget=0.11)
    assert timings["fast"]["repetitions"] == 12
    assert 3 <= timings["slow"]["repetitions"] <= 5 and timings["slow"]["median_ms"] >= 20
    assert sum(a != b for a, b in pairwise(ran)) >= 5
    assert timings["slow"]["min_ms"] <= timings["slow"]["median_ms"] <= timings["slow"]["p90_ms"]


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


def test_tables_leave_out_what_nothing_has_and_mark_what_one_lacks():
    rows = [{"a": 1.234, "b": "x", "c": None}, {"a": None, "b": "yy"}]
    assert markdown_table(rows, {"A=a": ".1f", "b": "", "c": "d"}) == "\n".join(
        ["|   A | b  |", "| --: | -- |", "| 1.2 | x  |", "|   - | yy |"]
    )
