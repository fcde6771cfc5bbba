"""The kernel of the responses that have a formula, in every type and on every device."""

import math

import pytest
import torch

from sehdr_warp.rasterizer.ops.response_curves import encode_with_slope
from sehdr_warp.response import response_by_name, response_names
from sehdr_warp.response.curve import EXTENSION_SLOPE

from ..rasterizer.scenes import relative_error

NAMES = [*response_names(), "gamma-3"]


def exposures(response):
    """Return exposures from black to far above white, and both sides of the toe's end and of the clip point."""
    top = response.clip_exposure if response.clips else 50.0
    even = torch.linspace(0.0, 1.5 * top, 500, dtype=torch.float64)
    return torch.cat([even, torch.logspace(-9, 3, 500, dtype=torch.float64) * top, torch.tensor([-1.0, -1e-9])])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("extension", [0.0, EXTENSION_SLOPE])
def test_every_device_and_type_has_the_values_and_slopes_of_float64(device, name, dtype, bound, extension):
    """tests/response holds those against published formulae and difference quotients."""
    response = response_by_name(name)
    exposure = exposures(response)
    # Where the slope jumps or is infinite, rounding decides on which side of the place a float32 falls.
    exposure = exposure[(exposure - response.clip_exposure).abs() > 1e-5 * min(response.clip_exposure, 1e3)]
    truth = response.encode_extended(exposure) if extension else response.encode(exposure)
    true_slope = torch.where(exposure > response.clip_exposure, extension / exposure, response.slope(exposure))
    value, slope = encode_with_slope(exposure.to(device, dtype), response.curve, extension)
    assert (value.cpu().double() - truth).abs().max() < bound
    finite = true_slope.isfinite()
    assert relative_error(slope[finite.to(device)], true_slope[finite]) < 10 * bound


def test_poison_stays_and_black_is_black(device):
    exposure = torch.tensor([math.nan, 0.0, math.inf], device=device)
    for name in NAMES:
        value, slope = encode_with_slope(exposure, response_by_name(name).curve, 0.0)
        assert value[0].isnan() and slope[0].isnan()
        assert value[1] == 0
        assert value[2] > 1 - 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_extreme_exposures_have_the_values_and_slopes_of_float64(device, name):
    extreme = torch.tensor([-1e30, -0.0, 1e-45, 1e-30, 1e30, 3e38], device=device)
    results = [encode_with_slope(each, response_by_name(name).curve, 0.05) for each in (extreme, extreme.double())]
    for ours, truth in zip(*results, strict=True):
        torch.testing.assert_close(ours.double(), truth, rtol=1e-3, atol=1e-6)
