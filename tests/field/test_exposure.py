"""Brackets against the paper's equation, and what is said about times that are none."""

import math

import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.field.exposure import bracket_log_radiance, exposure_times


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


def test_specifications():
    assert exposure_times(2.0) == (0.25, 0.5, 2.0, 16.0, 32.0)
    assert exposure_times(1 / 500, "1, 1/2") == pytest.approx((1 / 1000, 1 / 500))
    assert exposure_times(2.0, "1/8s, base, +2ev, -1EV, 16s") == pytest.approx((0.125, 1.0, 2.0, 8.0, 16.0))
    assert exposure_times(2.0, [0.5, 4]) == (1.0, 8.0)


@pytest.mark.parametrize(
    "spec", ["", "0", "-1", "nan", "1e400", "1/0", "2 stops", "1,1", "base,1", "1,2s", "infs", "9999ev", []]
)
def test_bad_specifications(spec):
    with pytest.raises(SehdrError, match="exposures") as error:
        exposure_times(2.0, spec)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("time", [0.0, -1.0, math.nan, math.inf])
def test_bad_times(time):
    for call in (
        lambda: exposure_times(time),
        lambda: bracket_log_radiance(torch.zeros(3), [1.0, time], 1.0),
        lambda: bracket_log_radiance(torch.zeros(3), [1.0], time),
    ):
        with pytest.raises(SehdrError, match=str(time)):
            call()
