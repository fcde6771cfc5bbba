"""`python -m benchmarks kernels` at a size that takes seconds."""

import json

import pytest
import torch

from benchmarks import kernels

from .command_line import call, refused

KERNELS = ["kernels", "--device", "cpu", "--sizes", "200@40x33", "--repetitions", "3"]


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
