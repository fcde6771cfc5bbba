"""Every quick case on every device, and that a defect is noticed."""

import json

import pytest
import torch

from benchmarks.stability import catalogue
from sehdr_warp.check import splat_cases

from .command_line import call, refused

SLOW = ("radiance-range", "scale-huge")  # the like of others here; the command measures them too
CPU = torch.device("cpu")


@pytest.mark.parametrize(
    "case", [case for case in catalogue.CASES if case.quick and case.name not in SLOW], ids=lambda case: case.name
)
def test_bounds_hold(case, device):
    readings = list(case.measure(torch.device(device)))
    assert readings
    assert [reading for reading in readings if not reading.holds] == []


@pytest.mark.parametrize("error", [5e-5, 1e-3])
def test_a_small_error_of_the_kernels_is_noticed(monkeypatch, error):
    """A relative error of a thousand float32 roundings, such as a coarser exponential makes."""
    rasterize = splat_cases.rasterize

    def wrong(means, log_scales, quaternions, opacities, *rest, **options):
        return rasterize(means, log_scales, quaternions, opacities * (1 - error), *rest, **options)

    monkeypatch.setattr(splat_cases, "rasterize", wrong)
    (case,) = catalogue.choose_cases("border", False)
    failed = [reading.quantity for reading in case.measure(CPU) if not reading.holds]
    assert "image" in failed and "alpha" in failed and "d/d features" in failed


def test_the_command_writes_its_result(tmp_path, capfd):
    path = tmp_path / "stability.json"
    assert call("stability", "--device", "cpu", "--cases", "quaternions,photos", "--json", path) == 0
    result = json.loads(path.read_text())
    assert [(row["case"], row["group"]) for row in result["rows"]] == [("quaternions", "splat"), ("photos", "light")]
    assert result["benchmark"] == "stability" and result["command"].startswith("python -m ")
    assert "2 cases, " in capfd.readouterr().out
    assert "exists already" in refused(capfd, "stability", "--device", "cpu", "--cases", "photos", "--json", path)
