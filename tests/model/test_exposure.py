"""Brackets against the paper's equation, and what is said about times that are none."""

import math

import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.exposure import bracket_log_radiance, exposure_times, is_seconds, read_exposures


def test_brackets_are_scalings(device):
    radiance = torch.rand(7, 3, dtype=torch.float64, device=device) + 1e-9
    times = (0.25, 2.0, 32.0)
    brackets = bracket_log_radiance(radiance.log(), times, 2.0).exp()
    assert brackets.shape == (3, 7, 3)
    for bracket, time in zip(brackets, times, strict=True):
        torch.testing.assert_close(bracket, radiance * time / 2.0)


def test_brackets_keep_zero_and_gradients():
    log_base = torch.tensor([-torch.inf, 0.0, 20.0], requires_grad=True)
    brackets = bracket_log_radiance(log_base, (0.5, 1.0), 1.0)
    brackets[:, 1:].sum().backward()
    assert brackets[0, 0] == -torch.inf and brackets.dtype == torch.float32
    assert log_base.grad[1:].tolist() == [2.0, 2.0]


def test_the_grammar():
    assert exposure_times(2.0) == (0.25, 0.5, 2.0, 16.0, 32.0)
    assert exposure_times(1 / 500, "1X, 1/2x") == pytest.approx((1 / 1000, 1 / 500))
    assert exposure_times(2.0, "1/8, base, +2ev, -1EV, 16s") == pytest.approx((0.125, 1.0, 2.0, 8.0, 16.0))
    assert exposure_times(2.0, [0.5, "1/250", 4]) == (0.004, 0.5, 4.0)
    (dark, bright) = read_exposures("8x,-3ev", 0.5)
    assert (dark.ev, bright.ev, bright.time, bright.label) == (-3.0, 3.0, 4.0, "ev+3.0")
    assert [is_seconds(item) for item in ("1/125", 0.5, "2s", "base", "1x", "-2ev")] == [True] * 3 + [False] * 3


@pytest.mark.parametrize(
    "spec", ["", "0", "-1", "nan", "1e400", "1/0", "2 stops", "1,1s", "base,1x", "1x,2s", "infs", "9999ev", "8xx", []]
)
def test_bad_specifications(spec):
    with pytest.raises(SehdrError, match="exposures") as error:
        exposure_times(2.0, spec)
    assert "\n" not in str(error.value)


def test_what_is_relative_needs_photos():
    assert [exposure.time for exposure in read_exposures("1/125,2", None)] == [0.008, 2.0]
    with pytest.raises(SehdrError, match="'8x' is relative to photos"):
        read_exposures("1,8x", None)


@pytest.mark.parametrize("time", [0.0, -1.0, math.nan, math.inf])
def test_bad_times(time):
    with pytest.raises(SehdrError, match=str(time)):
        exposure_times(time)
