"""The catalogue of `sehdr-warp check`: every quick case on every device, and that it would notice a defect."""

import json

import pytest
import torch

from sehdr_warp.check import catalogue, splats
from sehdr_warp.check.case import Case, Reading, compare
from sehdr_warp.errors import SehdrError
from tests.refusals import call, refused

SLOW = ("radiance-range", "scale-huge")  # the like of others here; `sehdr-warp check` measures them too


@pytest.mark.parametrize(
    "case", [case for case in catalogue.CASES if case.quick and case.name not in SLOW], ids=lambda case: case.name
)
def test_bounds_hold(case, device):
    readings = case.measure(torch.device(device))
    assert readings
    assert [reading for reading in readings if not reading.holds] == []


def test_names_are_unique_and_choose():
    names = [case.name for case in catalogue.CASES]
    assert len(set(names)) == len(names)
    assert [case.name for case in catalogue.choose_cases("needle, poison", False)][:2] == ["needle", "poison-gaussians"]
    assert len(catalogue.choose_cases(None, True)) < len(catalogue.choose_cases(None, False)) == len(names)
    with pytest.raises(SehdrError, match="--cases nope: no such case"):
        catalogue.choose_cases("nope", False)


@pytest.mark.parametrize("error", [5e-5, 1e-3])
def test_a_small_error_of_the_kernels_is_noticed(monkeypatch, error):
    """A relative error of a thousand float32 roundings, such as a coarser exponential makes."""
    rasterize = splats.rasterize

    def wrong(means, log_scales, quaternions, opacities, *rest, **options):
        return rasterize(means, log_scales, quaternions, opacities * (1 - error), *rest, **options)

    monkeypatch.setattr(splats, "rasterize", wrong)
    case = next(case for case in catalogue.CASES if case.name == "border")
    failed = [reading.quantity for reading in case.measure(torch.device("cpu")) if not reading.holds]
    assert "image" in failed and "alpha" in failed and "d/d features" in failed


def test_bounds_follow_the_condition_not_the_result():
    """1 - x next to 1: the error of the float32 result is allowed only as far as x's own rounding causes it."""
    near = {"x": torch.full((5,), 1 - 2.0**-12, dtype=torch.float64)}
    far = {"x": torch.full((5,), 0.5, dtype=torch.float64)}
    cpu = torch.device("cpu")
    ill = compare(lambda x: {"y": 1 - x}, lambda _, x: {"y": 1 - x}, near, cpu)[0]
    well = compare(lambda x: {"y": 1 - x}, lambda _, x: {"y": 1 - x}, far, cpu)[0]
    assert ill.bound > 100 * well.bound and ill.holds and well.holds
    off = compare(lambda x: {"y": (1 - x) * 1.0001}, lambda _, x: {"y": 1 - x}, far, cpu)[0]
    assert not off.holds and off.bound == well.bound


def test_nan_fails():
    assert not Reading("x", float("nan"), 1.0).holds


def test_the_command_writes_its_result_and_fails_with_a_bound(tmp_path, capfd, monkeypatch):
    path = tmp_path / "check.json"
    assert call("check", "--device", "cpu", "--cases", "quaternions,photos", "--json", path) == 0
    result = json.loads(path.read_text())
    assert result["failed"] == [] and [row["case"] for row in result["cases"]] == ["quaternions", "photos"]
    assert all({"quantity", "error", "bound", "holds"} == set(r) for row in result["cases"] for r in row["readings"])
    assert "2 cases, " in capfd.readouterr().out
    assert "exists already" in refused(capfd, "check", "--device", "cpu", "--cases", "photos", "--json", path)

    broken = Case("broken", "splat", "fails", lambda device: [Reading("error", float("nan"), 1e-6)])
    monkeypatch.setattr(catalogue, "CASES", (broken,))
    line = refused(capfd, "check", "--device", "cpu", "--json", tmp_path / "failed.json")
    assert "1 of 1 cases exceed their bounds on cpu: broken" in line
    assert json.loads((tmp_path / "failed.json").read_text())["failed"] == ["broken"]
