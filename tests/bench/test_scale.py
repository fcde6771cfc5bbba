"""`bench scale`: points, slopes, the verdict, and the training step on gsplat's kernels."""

import json
import sys
from types import SimpleNamespace

import pytest
import torch

from sehdr_warp.bench import commands, scale
from sehdr_warp.bench.peer_gsplat import rasterize_with_gsplat, spherical_harmonics_with_gsplat
from sehdr_warp.bench.peers import Peer
from sehdr_warp.bench.report import format_report, write_report
from sehdr_warp.bench.scale import Sweep, bench_scale, parse_sweeps, verdict
from sehdr_warp.bench.slopes import fit_slopes
from sehdr_warp.bench.splats import Size, make_splat_scene
from sehdr_warp.bench.stages import STAGES
from sehdr_warp.errors import SehdrError
from sehdr_warp.splatting import rasterize, spherical_harmonics

CPU = torch.device("cpu")


def points(what, times):
    return [
        {"sweep": "gaussians", "implementation": "sehdr-warp", "what": what, "varied": n, "min_ms": t}
        for n, t in zip((1000, 10_000, 100_000, 1_000_000), times)
    ]


def test_a_quadratic_stage_is_found_and_a_linear_one_is_not():
    slopes = fit_slopes(points("linear", (5, 5, 40, 400)) + points("quadratic", (1, 1, 100, 10_000)))
    linear, quadratic = slopes
    assert linear["slope_large"] == pytest.approx(0.9515, abs=1e-3)
    assert quadratic["slope_large"] == pytest.approx(2.0)
    assert quadratic["slope"] == pytest.approx(1.4)
    assert (quadratic["from"], quadratic["large_from"], quadratic["to"]) == (1000, 10_000, 1_000_000)
    assert verdict(slopes[:1]).startswith(
        "no step quadratic: the steepest slope at the large end is 0.95 (time of linear"
    )
    assert verdict(slopes) == (
        "steeper than linear at the large end: 2.00 (time of quadratic over gaussians, 10,000 to 1,000,000)"
    )
    assert "two points" in verdict(fit_slopes(points("one", (1,))))


def fake_gsplat(monkeypatch):
    """gsplat's call, drawn by ours: what it is given and what it returns are as in gsplat 1.5."""

    def rasterization(
        means, quats, scales, opacities, colors, viewmats, matrix, width, height,
        *, packed, rasterize_mode="classic", eps2d=0.3,
    ):  # fmt: skip
        matrix = matrix[0]
        camera = torch.stack([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
        drawn = rasterize(
            means, scales.log(), quats, opacities, colors, viewmats[0], camera, width, height,
            antialiased=rasterize_mode == "antialiased", low_pass=eps2d,
        )  # fmt: skip
        radii = drawn.radii[None, :, None].expand(-1, -1, 2)
        info = {"means2d": drawn.means2d[None], "radii": radii, "depths": drawn.depths[None]}
        return drawn.image[None], drawn.alpha[None, ..., None], info

    def harmonics(degrees_to_use, dirs, coeffs):
        return spherical_harmonics(degrees_to_use, coeffs, dirs, dirs.new_zeros(3))

    fake = SimpleNamespace(rasterization=rasterization, spherical_harmonics=harmonics)
    monkeypatch.setitem(sys.modules, "gsplat", fake)


def test_gsplat_draws_what_a_training_step_of_ours_asks_for(monkeypatch):
    fake_gsplat(monkeypatch)
    scene = make_splat_scene(Size(200, 50, 40), 4)
    options = {"low_pass": 0.1, "antialiased": True}
    ours, theirs = rasterize(*scene.arguments, **options), rasterize_with_gsplat(*scene.arguments, **options)
    torch.testing.assert_close(theirs.image, ours.image, rtol=1e-5, atol=1e-6)
    assert torch.equal(theirs.visible, ours.visible)
    gradients = [torch.autograd.grad(drawn.image.square().sum(), scene.leaves) for drawn in (ours, theirs)]
    for mine, other in zip(*gradients, strict=True):
        torch.testing.assert_close(other, mine, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("joined", [True, False])
def test_gsplat_evaluates_the_harmonics_that_a_training_step_of_ours_asks_for(monkeypatch, joined):
    fake_gsplat(monkeypatch)
    torch.manual_seed(3)
    coefficients, means, position = torch.randn(20, 9, 3), torch.randn(20, 3), torch.randn(3)
    given = coefficients if joined else (coefficients[:, :1], coefficients[:, 1:])
    ours, theirs = (
        evaluate(2, given, means, position) for evaluate in (spherical_harmonics, spherical_harmonics_with_gsplat)
    )
    torch.testing.assert_close(theirs, ours)


@pytest.mark.parametrize("who", ["sehdr-warp", "gsplat"])
def test_steps_of_gsplat_are_launched_and_ours_recorded(who):
    config = scale._step_config(who, Size(200, 48, 40))
    assert config.schedule.recorded == (who == "sehdr-warp")
    assert (config.densification.stop, config.densification.max_gaussians) == (0, 201)


def test_points_have_stages_memory_steps_and_gsplat(monkeypatch, tmp_path):
    fake_gsplat(monkeypatch)

    def renderer(scene):
        return lambda: rasterize_with_gsplat(*scene.arguments).image

    gsplat = Peer("gsplat", "1.5.3", renderer, None, 1e-3)
    monkeypatch.setattr(scale, "find_peers", lambda device: ([gsplat], ["gswarp not compared: it needs CUDA"]))
    sweep = Sweep("gaussians", ((Size(200, 48, 40), 9), (Size(800, 48, 40), 9)))
    report = bench_scale([sweep], CPU, repetitions=1, budget=0.01)
    rows = [row for row in report["rows"] if row["stage"] == "scale"]
    ours = [row["what"] for row in rows if row["implementation"] == "sehdr-warp" and row["varied"] == 200]
    assert ours == [*STAGES, scale.WHOLE_SPLAT, scale.WHOLE_STEP]
    theirs = [(row["implementation"], row["what"]) for row in rows if row["implementation"].startswith("gsplat")]
    assert (
        theirs
        == [
            (scale.GSPLAT, scale.WHOLE_SPLAT),
            (scale.GSPLAT, scale.WHOLE_STEP),
            (scale.GSPLAT_AND_HARMONICS, scale.WHOLE_STEP),
        ]
        * 2
    )
    assert all(row["median_ms"] > 0 for row in rows)
    weighed = [row for row in rows if row["what"] in (scale.WHOLE_SPLAT, scale.WHOLE_STEP)]
    assert all(row["peak_memory_bytes"] > 48 * 40 * 9 * 4 for row in weighed)
    slopes = [row for row in report["rows"] if row["stage"] == "slope"]
    # Time of each stage and of five wholes, memory of the wholes.
    assert len(slopes) == len(STAGES) + 5 + 5
    assert report["notes"][-1] == verdict(slopes)
    assert [check["what"] for check in report["checks"]].count("gsplat: image") == 2
    assert sum(check["what"].endswith(": loss of the first step") for check in report["checks"]) == 2 * 2
    assert all(check["passed"] for check in report["checks"])
    write_report(report, out=tmp_path)
    assert (tmp_path / "scale.png").read_bytes()[:4] == b"\x89PNG"
    assert json.loads((tmp_path / "scale.json").read_text())["benchmark"] == "scale"
    table = format_report(report)
    assert "at the large end" in table and "| gswarp" not in table


def test_sweeps_are_named_and_ascend():
    chosen = parse_sweeps("pixels, channels", "cuda")
    assert [sweep.name for sweep in chosen] == ["pixels", "channels"]
    for device in ("cuda", "cpu"):
        for sweep in parse_sweeps("gaussians,pixels,channels", device):
            varied = [scale._row(sweep.name, *point, "", "")["varied"] for point in sweep.points]
            assert varied == sorted(set(varied)) and len(varied) >= 4
    with pytest.raises(SehdrError, match="--sweeps pixel: 'pixel' is none"):
        parse_sweeps("pixel", "cpu")


@pytest.mark.parametrize("no_steps", [False, True])
def test_the_command_line_measures_steps_unless_told_not_to(no_steps, monkeypatch):
    def measured(*_, steps, **__):
        raise SehdrError(f"steps: {steps}")

    monkeypatch.setattr(scale, "bench_scale", measured)
    with pytest.raises(SehdrError, match=f"steps: {not no_steps}"):
        commands.run_bench(commands.Bench(commands.Scale(no_steps=no_steps, device="cpu")))
