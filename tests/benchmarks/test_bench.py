"""`python -m benchmarks kernels` and `step`, at sizes that take seconds."""

import json
import re
import sys
import time
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from benchmarks import gsplat_peer, kernels, step
from benchmarks.results import finish, machine_line, markdown_table, new_result
from benchmarks.splats import Size, make_splat_scene, parse_size
from benchmarks.timing import Variant, peak_memory, time_variants
from sehdr_warp.check.result import build
from sehdr_warp.errors import SehdrError
from sehdr_warp.rasterizer import rasterize

from .command_line import call, refused

KERNELS = ["kernels", "--device", "cpu", "--sizes", "200@40x33", "--repetitions", "3"]
CPU = torch.device("cpu")
BRIEF = {"repetitions": 1}


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


def test_peak_memory_counts_what_is_held_at_once():
    def run():
        for _ in range(3):
            a = torch.empty(1_000_000, dtype=torch.float32)
            b = torch.empty(500_000, dtype=torch.float32)
            del a, b

    assert peak_memory(Variant(run), CPU) == pytest.approx(6_000_000, rel=0.01)


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


def test_a_step_with_another_loss_fails(monkeypatch):
    right = step.rasterize_reference

    def other(means, log_scales, *rest, **options):
        return right(means, log_scales + 0.01, *rest, **options)

    monkeypatch.setattr(step, "rasterize_reference", other)
    result = step.bench_step(Size(300, 40, 32), CPU, presets=["default"], views=4, **BRIEF)
    with pytest.raises(SehdrError, match="loss of step 1"):
        finish(result)


def fake_gsplat(monkeypatch):
    """gsplat's call, drawn by ours: what it is given and what it returns are as in gsplat 1.5."""

    def rasterization(
        means, quats, scales, opacities, colors, viewmats, matrix, width, height,
        *, packed, rasterize_mode="classic", eps2d=0.3,
    ):  # fmt: skip
        matrix = matrix[0]
        camera = torch.stack([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
        image_of = rasterize(
            means, scales.log(), quats, opacities, colors, viewmats[0], camera, width, height,
            antialiased=rasterize_mode == "antialiased", eps2d=eps2d,
        )  # fmt: skip
        radii = image_of.radii[None, :, None].expand(-1, -1, 2)
        info = {"means2d": image_of.means2d[None], "radii": radii, "depths": image_of.depths[None]}
        return image_of.image[None], image_of.alpha[None, ..., None], info

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    monkeypatch.setattr(kernels, "note_missing", lambda result, device: True)


def test_gsplat_draws_what_we_draw(monkeypatch):
    fake_gsplat(monkeypatch)
    scene = make_splat_scene(Size(200, 50, 40), 4)
    options = {"eps2d": 0.1, "antialiased": True}
    ours, theirs = (
        rasterize(*scene.arguments, **options),
        gsplat_peer.rasterize_with_gsplat(*scene.arguments, **options),
    )
    torch.testing.assert_close(theirs.image, ours.image, rtol=1e-5, atol=1e-6)
    assert torch.equal(theirs.visible, ours.visible)
    gradients = [torch.autograd.grad(image_of.image.square().sum(), scene.leaves) for image_of in (ours, theirs)]
    for mine, other in zip(*gradients, strict=True):
        torch.testing.assert_close(other, mine, rtol=1e-3, atol=1e-3)
    result = kernels.bench_kernels([Size(150, 40, 32)], [5], CPU, **BRIEF)
    assert {row["implementation"] for row in result["rows"]} == {"sehdr-warp", "gsplat", "plain torch"}
    assert all(check["passed"] for check in result["checks"])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="a GPU has times of its own")
def test_times_of_host_and_gpu_are_apart(monkeypatch):
    order = []
    for name in ("time_variants", "kernel_milliseconds"):

        def traced(*args, name=name, real=getattr(kernels, name), **options):
            order.append(name)
            return real(*args, **options)

        monkeypatch.setattr(kernels, name, traced)
    rows = kernels.bench_kernels([Size(150, 40, 32)], [3, 5], torch.device("cuda:0"), **BRIEF)["rows"]
    assert all(row["device_ms"] > 0 and row["host_ms"] > 0 for row in rows)
    assert order == sorted(order, reverse=True), "profiling slows what comes after it"


def test_tables_leave_out_what_nothing_has_and_mark_what_one_lacks():
    rows = [{"a": 1.234, "b": "x", "c": None}, {"a": None, "b": "yy"}]
    assert markdown_table(rows, {"A=a": ".1f", "b": "", "c": "d"}) == "\n".join(
        ["|   A | b  |", "| --: | -- |", "| 1.2 | x  |", "|   - | yy |"]
    )


def test_a_result_names_its_build():
    result = new_result("step", torch.device("cpu"), {})
    assert re.fullmatch("[0-9a-f]{8}", result["machine"]["build"]) and result["machine"]["build"] == build()
    assert f"build {build()}" in machine_line(result)
