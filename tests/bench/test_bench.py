"""`sehdr-warp bench` from the command line, at sizes that take seconds."""

import json

import pytest
import torch

from sehdr_warp.bench import kernels, step, training
from sehdr_warp.bench.checks import require
from sehdr_warp.bench.splats import Size
from sehdr_warp.bench.training import bench_training, plain_config
from sehdr_warp.errors import SehdrError

from ..refusals import call
from ..training.toy import toy_scene

KERNELS = ["bench", "kernels", "--device", "cpu", "--sizes", "200@40x33", "--repetitions", "3", "--budget", "1"]
CPU = torch.device("cpu")


def test_kernels_report_times_checks_and_machine(tmp_path, capsys):
    assert call(*KERNELS, "--channels", "3,4", "--peers", "--json", tmp_path / "a.json", "--out", tmp_path / "out") == 0
    report = json.loads((tmp_path / "a.json").read_text())
    assert report == json.loads((tmp_path / "out" / "kernels.json").read_text())
    assert (tmp_path / "out" / "kernels.png").read_bytes()[:4] == b"\x89PNG"
    table = capsys.readouterr().out
    assert table.strip() == (tmp_path / "out" / "kernels.md").read_text().strip()
    assert "gsplat not compared: it needs CUDA" in table
    assert (report["schema"], report["benchmark"]) == (1, "kernels")
    # The installed metadata may leave out the build that torch names, such as +cu130.
    assert torch.__version__.startswith(report["machine"]["versions"]["torch"].split("+")[0])
    splats = [row for row in report["rows"] if row["stage"] == "splat"]
    assert {(row["channels"], row["pass"], row["implementation"]) for row in splats} == {
        (channels, passes, name)
        for channels in (3, 4)
        for passes in ("forward", "forward + backward")
        for name in ("sehdr-warp", "plain torch")
    }
    assert all(row["median_ms"] > 0 and row["repetitions"] == 3 for row in report["rows"])
    assert all(row["peak_memory_bytes"] >= 40 * 33 * row["channels"] * 4 for row in splats)
    ratios = [row for row in splats if row["implementation"] == "plain torch" and row["ours_over_this"] > 0]
    assert len(ratios) == 4
    # Plain torch and ours: image and five gradients, for two channel counts.
    assert len(report["checks"]) == 2 * 2 * 6
    assert all(check["passed"] and check["difference"] < 1e-4 for check in report["checks"])


def test_a_wrong_image_is_reported_and_fails(tmp_path, monkeypatch, capsys):
    right = kernels.rasterize

    def wrong(*arguments, **options):
        rendering = right(*arguments, **options)
        return type(rendering)(**{**vars(rendering), "image": rendering.image * 1.001})

    monkeypatch.setattr(kernels, "rasterize", wrong)
    assert call(*KERNELS, "--channels", "3", "--json", tmp_path / "a.json") == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "correctness checks failed" in error
    assert "sehdr-warp: image" in error
    assert "do not use these times" in error
    # What was measured is kept, with the checks that condemn it.
    assert not all(check["passed"] for check in json.loads((tmp_path / "a.json").read_text())["checks"])


def test_a_wrong_gradient_fails(monkeypatch):
    right = kernels.rasterize

    def wrong(means, log_scales, *rest, **options):
        return right(means, 1.01 * log_scales - 0.01 * log_scales.detach(), *rest, **options)

    monkeypatch.setattr(kernels, "rasterize", wrong)
    report = kernels.bench_kernels([Size(200, 40, 33)], [3], CPU, repetitions=1, budget=0.1)
    with pytest.raises(SehdrError, match="1 of 12 .* gradient of log_scales"):
        require(report["checks"])


def test_files_in_the_way_are_named_before_anything_is_measured(tmp_path, capsys):
    (tmp_path / "a.json").write_text("mine")
    assert call(*KERNELS, "--json", tmp_path / "a.json") == 1
    captured = capsys.readouterr()
    assert "exists already" in captured.err
    assert "ms" not in captured.out
    assert (tmp_path / "a.json").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--channels", "3,x"], "--channels 3,x: not whole numbers from 1"),
        (["--channels", "0"], "--channels 0: not whole numbers from 1"),
        (["--sizes", "9@9"], "size 9@9: not a size"),
        (["--repetitions", "0"], "--repetitions 0: not positive"),
    ],
)
def test_arguments_that_do_not_fit_are_named(arguments, message, capsys):
    assert call("bench", "kernels", "--device", "cpu", *arguments) == 1
    assert message in capsys.readouterr().err


def test_step_times_whole_steps_and_checks_their_loss(tmp_path, capsys):
    command = ["bench", "step", "--device", "cpu", "--size", "400@40x32", "--repetitions", "3", "--budget", "1"]
    assert call(*command, "--json", tmp_path / "a.json") == 0
    report = json.loads((tmp_path / "a.json").read_text())
    ours, plain = report["rows"]
    assert (ours["implementation"], plain["implementation"]) == ("sehdr-warp", "plain torch")
    assert ours["gaussians"] == plain["gaussians"] == 400
    assert plain["ours_over_this"] == pytest.approx(ours["median_ms"] / plain["median_ms"])
    assert ours["densifications"] == 1
    assert ours["amortised_steps"] == 100
    assert ours["gaussians_after"] <= 441
    # In the thick of a training: all degrees of the harmonics, and densification under way.
    assert report["settings"]["first_iteration"] > 3000
    assert [check["what"] for check in report["checks"]] == [
        "sehdr-warp: loss of step 1",
        f"sehdr-warp: loss of step {step.CHECKED_STEPS}",
    ]
    assert "with densification" in capsys.readouterr().out


def test_a_step_with_another_loss_fails(monkeypatch):
    right = step.rasterize_reference

    def other(means, log_scales, *rest, **options):
        return right(means, log_scales + 0.01, *rest, **options)

    monkeypatch.setattr(step, "rasterize_reference", other)
    report = step.bench_step(Size(300, 40, 32), CPU, repetitions=1, budget=0.1)
    with pytest.raises(SehdrError, match="loss of step 1"):
        require(report["checks"])


def test_a_step_that_ignores_the_plain_rasterizer_is_refused():
    with pytest.raises(SehdrError, match="ours with ours"), step.plain_torch_rasterizer():
        pass


def test_training_keeps_3dgs_thresholds_whatever_its_length():
    config = plain_config(2000, 0)
    assert config.scaled(config.densification.start) == 500
    assert config.scaled(config.densification.every) == 100
    assert config.scaled(config.densification.reset_every) == 3000
    assert config.scaled(config.schedule.harmonics_every) == 1000
    assert config.model.radiance == "display"
    assert config.loss.form == "blend"


def test_training_reports_quality_time_and_size(tmp_path):
    report = bench_training(toy_scene(), CPU, iterations=30, out=tmp_path)
    (row,) = report["rows"]
    assert row["implementation"] == "sehdr-warp"
    assert row["iterations"] == 30
    assert row["gaussians"] == 60
    assert 5 < row["psnr_ldr"] < 60
    assert row["train_seconds"] > 0
    assert row["peak_gpu_memory_bytes"] is None
    assert report["notes"] == ["gsplat not compared: it needs CUDA"]
    assert (tmp_path / "run" / "summary.json").exists()


def test_training_puts_gsplat_beside_ours(monkeypatch):
    calls = []

    def fake(scene, config, device, *, resets=True, steps=None):
        calls.append((resets, steps))
        return {
            "psnr_ldr": 20.0,
            "train_seconds": 1.0,
            "gaussians": 7,
            "iterations": config.schedule.iterations,
            "peak_gpu_memory_bytes": 5,
        }

    peer = training.find_peers(CPU)[0] or [type("Peer", (), {"name": "gsplat", "version": "1.5.3"})]
    monkeypatch.setattr(training, "find_peers", lambda device: (peer, []))
    monkeypatch.setattr(training, "train_with_gsplat", fake)
    report = bench_training(toy_scene(), CPU, iterations=5, released=True)
    assert [row["implementation"] for row in report["rows"]] == ["sehdr-warp", "gsplat", "gsplat without resets"]
    assert [row["iterations"] for row in report["rows"]] == [5, 5, 5]
    # Each is warmed up before it is timed.
    assert calls == [(True, 5), (True, None), (False, 5), (False, None)]


def test_training_refuses_terms_that_are_not_equal():
    with pytest.raises(SehdrError, match="has no points"):
        bench_training(toy_scene(with_points=False), CPU, iterations=5)
