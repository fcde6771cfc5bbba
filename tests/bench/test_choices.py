"""`bench choices`: errors against float64 truth, times, and the sentences made of them."""

import json

import pytest
import torch

from sehdr_warp.bench import choices
from sehdr_warp.bench.choices import Option, bench_choices, conclusions, errors, options, with_features
from sehdr_warp.bench.report import write_report
from sehdr_warp.bench.splats import Size, make_splat_scene
from sehdr_warp.errors import SehdrError
from sehdr_warp.splatting import BlendStyle

CPU = torch.device("cpu")
SIZE = Size(80, 32, 24)


@pytest.fixture(scope="module")
def measured():
    scene = with_features(make_splat_scene(SIZE, 1), "HDR")
    return scene, choices.make_truths(scene)


def test_hdr_features_span_five_decades():
    scene = with_features(make_splat_scene(Size(4000, 64, 64), 3), "HDR")
    values = scene.leaves[-1].detach()
    assert 4.5 < (values.max() / values.min()).log10() < 5.6


def test_errors_shrink_where_exactness_is_bought(measured):
    scene, truth = measured

    def error(**values):
        return errors(Option("", "", **values), scene, truth)

    coarse, usual, fine = (error(alpha_threshold=1 / n) for n in (64, 255, 65536))
    for name in ("image_error", "gradient_error"):
        assert coarse[name] > usual[name] > fine[name]
    assert error(style=BlendStyle(transmittance_min=1e-2))["image_error"] > usual["image_error"]
    cubic = error(alpha_threshold=1 / 65536, style=BlendStyle(exponential_degree=3))
    assert fine["image_error"] < 5e-4 < cubic["image_error"] < 1e-2
    # Early termination's own share is small, and the threshold's hides it.
    late, early = error(), error(style=BlendStyle(transmittance_min=1e-2))
    assert late["own_image_error"] < 1e-3 < late["image_error"]
    assert early["own_image_error"] > 5 * late["own_image_error"]
    assert set(fine["gradient_errors"]) == set(choices.NAMES)


def test_rounded_features_change_the_image_and_pass_gradients(measured):
    scene, truth = measured
    half, coarse = (errors(option, scene, truth) for option in options("cpu") if option.rounded is not None)
    usual = errors(Option("", ""), scene, truth)
    assert abs(half["image_error"] - usual["image_error"]) < 1e-3
    assert coarse["image_error"] > half["image_error"]
    assert coarse["gradient_errors"]["features"] == pytest.approx(usual["gradient_errors"]["features"], rel=1e-3)


def test_each_choice_has_its_default_once():
    for device in ("cpu", "cuda"):
        defaults = [option.choice for option in options(device) if option.is_default]
        assert defaults == list(dict.fromkeys(option.choice for option in options(device)))


def test_every_option_is_timed_and_weighed(monkeypatch, tmp_path):
    few = [option for option in options("cpu") if option.value in ("1/64", "1/255", "float16", "float32")]
    monkeypatch.setattr(choices, "options", lambda device: few)
    report = bench_choices(SIZE, CPU, iterations=0, tile_sizes=False, repetitions=1, budget=0.01)
    assert [(row["value"], row["features"]) for row in report["rows"]] == [
        (option.value, kind) for kind in ("HDR", "LDR") for option in few
    ]
    assert all(row["image_error"] > 0 for row in report["rows"])
    assert {row["value"] for row in report["rows"] if row["median_ms"] is None} == {"float16"}
    assert all(row["times_default"] == 1 for row in report["rows"] if row["default"])
    assert all(check["passed"] for check in report["checks"])
    write_report(report, out=tmp_path)
    assert (tmp_path / "choices.png").read_bytes()[:4] == b"\x89PNG"
    assert json.loads((tmp_path / "choices.json").read_text())["rows"][0]["choice"] == "alpha threshold"


def test_a_tile_size_is_measured_in_its_own_process(monkeypatch):
    monkeypatch.setattr(choices, "TILE_SIZES", (8, 16))
    rows = choices._tile_rows(SIZE, CPU, 1, 0.01)
    assert [(row["value"], row["features"]) for row in rows] == [
        (edge, kind) for edge in ("8", "16") for kind in ("HDR", "LDR")
    ]
    # The exact test of ellipse and tile makes the image independent of the tiles.
    assert rows[0]["image_error"] == pytest.approx(rows[2]["image_error"], rel=1e-3)
    assert rows[2]["times_default"] == 1
    with pytest.raises(SehdrError, match="tiles of 8 pixels could not be measured"):
        choices._tile_rows(Size(0, 0, 0), CPU, 1, 0.01)


def row(value, time, error, default=False):
    return {
        "stage": "choice", "choice": "x", "value": value, "default": default, "features": "HDR", "median_ms": time,
        "times_default": time, "own_image_error": error, "own_gradient_error": 2 * error,
    }  # fmt: skip


def test_conclusions_come_from_the_figures():
    rows = [row("a", 1.0, 1e-2, default=True), row("b", 1.5, 1e-3), row("c", 1.2, 5e-3), row("d", 0.8, 5e-2)]
    (line,) = conclusions(rows)
    assert line == (
        "x: the default a has image error 1.0e-02, gradient error 2.0e-02; c has image error 5.0e-03, gradient error "
        "1.0e-02 at 1.20 times the time; d takes 0.80 times the time, image error 5.0e-02, gradient error 1.0e-01"
    )
    (line,) = conclusions([row("a", 1.0, 1e-2, default=True), row("b", 1.5, 1e-2)])
    assert line.endswith("no value is more exact; none is more than 3 % faster")
