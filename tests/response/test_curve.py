"""Every response: its inverse, its derivative, its limits."""

import json
import math

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.response import Response, response_by_name, response_names
from sehdr_warp.response.curve import EXTENSION_SLOPE, HALF_CODE
from sehdr_warp.response.table import TabulatedResponse

EXTREMES = [0.0, 1e-12, 1e-6, 1e-3, 0.18, 0.999, 1.0, 1.001, 11.2, 1e3, 1e9]
TABLES = {  # Even samples as DoRF's, and few.
    "even": (np.linspace(0.0, 1.0, 1024), np.linspace(0.0, 1.0, 1024) ** 0.6),
    "sparse": ([0.0, 0.01, 0.1, 0.5, 2.0, 4.0], [0.02, 0.1, 0.35, 0.7, 0.95, 1.0]),
}


@pytest.fixture(params=[*response_names(), "gamma-1.8", "colour:S-Log3", *TABLES], scope="module")
def response(request) -> Response:
    name = request.param
    return TabulatedResponse(name, *TABLES[name]) if name in TABLES else response_by_name(name)


def domain(response: Response, count: int = 4001) -> np.ndarray:
    """Exposures over 40 octaves up to the clip point, or to white for a curve that has none."""
    top = response.clip_exposure if response.clips else response.white
    return top * np.exp2(np.linspace(-40, 0, count))


def test_decode_inverts_encode_and_encode_every_16_bit_code(response):
    exposures = domain(response)
    ulp = np.spacing(response.encode(exposures)) / response.slope(exposures)  # What the value's own rounding hides.
    off = abs(response.decode(response.encode(exposures)) - exposures)
    np.testing.assert_array_less(off, 1e-9 * exposures + 8 * ulp)
    codes = np.arange(65536) / 65535
    codes = codes[(codes >= response.black) & (codes <= response.peak - (0 if response.clips else HALF_CODE))]
    np.testing.assert_allclose(response.encode(response.decode(codes)), codes, atol=1e-9)
    single = codes.astype(np.float32)
    np.testing.assert_allclose(response.encode(response.decode(single)), single, atol=5e-7)


def test_encode_rises(response):
    encoded = response.encode(domain(response))
    assert (np.diff(encoded) > 0).all() if response.black == 0 else (np.diff(encoded) >= 0).all()
    assert encoded[0] >= 0 and encoded[-1] <= 1
    single = response.encode(domain(response).astype(np.float32))
    assert single.dtype == np.float32 and (np.diff(single) > -2e-7).all()


def test_white_and_clip(response):
    assert response.encode(response.white) == pytest.approx(response.peak - HALF_CODE, abs=1e-9)
    assert round(float(response.encode(response.white * 1.0001)) * 255) == 255
    assert response.clips == math.isfinite(response.clip_exposure)
    if response.clips:
        assert response.encode(10 * response.clip_exposure) == pytest.approx(response.peak, abs=1e-12)
    assert response.decode(1.0) == pytest.approx(response.clip_exposure if response.clips else response.white)


def test_gradient_is_the_difference_quotient(response):
    top = response.clip_exposure if response.clips else response.white
    generator = torch.Generator().manual_seed(0)
    # Kept from nodes and breaks by chance; a step far smaller than a cell of any table.
    exposures = (top * torch.rand(200, generator=generator, dtype=torch.float64) ** 3).requires_grad_()
    step = 1e-7 * exposures.detach()
    quotient = (response.encode(exposures + step) - response.encode(exposures - step)).detach() / (2 * step)
    (gradient,) = torch.autograd.grad(response.encode(exposures).sum(), exposures)
    assert (gradient - quotient).norm() < 1e-5 * quotient.norm()
    (extended,) = torch.autograd.grad(response.encode_extended(exposures).sum(), exposures)
    assert torch.equal(gradient, extended)
    torch.testing.assert_close(gradient, response.slope(exposures.detach()), rtol=1e-12, atol=0)
    values = response.encode(exposures.detach()).requires_grad_()
    (inverse,) = torch.autograd.grad(response.decode(values).sum(), values)
    assert (inverse * gradient - 1).abs().max() < 1e-3  # Tables: a value rounded across a node takes the next slope.


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extremes_stay_finite(response, device, dtype):
    exposures = torch.tensor(EXTREMES, dtype=dtype, device=device, requires_grad=True)
    for encode in (response.encode, response.encode_extended):
        value = encode(exposures)
        (gradient,) = torch.autograd.grad(value.sum(), exposures)
        assert value.dtype == dtype and value.device == exposures.device
        assert value.isfinite().all() and gradient.isfinite().all() and (gradient >= 0).all()
        assert (value.diff() >= 0).all()
        assert gradient[0] > 0, "black must be able to become brighter"
    assert response.encode(exposures).max() <= 1
    value = response.encode(exposures).detach()
    assert response.decode(value).isfinite().all()


def test_extension_continues_in_log_exposure(response):
    exposures = domain(response)
    np.testing.assert_array_equal(response.encode_extended(exposures), response.encode(exposures))
    if not response.clips:
        np.testing.assert_array_equal(response.encode_extended(1e6), response.encode(1e6))
        return
    clip = response.clip_exposure
    beyond = torch.tensor([clip * 1.0000001, clip * math.e, clip * 1e6], dtype=torch.float64, requires_grad=True)
    value = response.encode_extended(beyond)
    expected = response.peak + EXTENSION_SLOPE * torch.log(beyond / clip)
    torch.testing.assert_close(value, expected, atol=1e-9, rtol=0)
    value.sum().backward()
    torch.testing.assert_close(beyond.grad, EXTENSION_SLOPE / beyond.detach())


def test_outside_the_domain(response):
    exposures = torch.tensor([-1.0, float("nan")], requires_grad=True)
    value = response.encode(exposures)
    assert value[0].item() == pytest.approx(response.black) and value[1].isnan()
    value[0].backward()
    assert exposures.grad[0] == 0
    top = response.clip_exposure if response.clips else response.white
    np.testing.assert_allclose(response.decode([-0.5, 1.5]), [0.0, top], rtol=1e-9)


def test_json_round_trip_is_exact(response):
    again = Response.from_dict(json.loads(json.dumps(response.to_dict())))
    exposures = domain(response, 997)
    np.testing.assert_array_equal(again.encode(exposures), response.encode(exposures))
    assert (again.name, again.white, again.clips) == (response.name, response.white, response.clips)


def test_numpy_in_numpy_out(response):
    image = np.random.default_rng(0).random((5, 4, 3), dtype=np.float32)[::-1]
    image.setflags(write=False)
    encoded = response.encode(image)
    assert isinstance(encoded, np.ndarray) and encoded.dtype == np.float32 and encoded.shape == image.shape
    np.testing.assert_array_equal(encoded, response.encode(torch.tensor(image.copy())).numpy())
    assert response.encode(0.25).dtype == np.float64


@pytest.mark.parametrize(
    "damage", [{}, {"kind": "x"}, {"kind": "table"}, {"kind": "analytic", "name": 3}, None, {"kind": "analytic"}]
)
def test_damaged_descriptions_are_refused(damage):
    with pytest.raises(SehdrError):
        Response.from_dict(damage)


def test_integer_tensors_are_refused():
    with pytest.raises(TypeError, match="float32"):
        response_by_name("srgb").encode(torch.tensor([128], dtype=torch.uint8))


@pytest.mark.parametrize(("dtype", "most"), [(np.uint8, 255), (np.uint16, 65535)])
def test_codes_that_are_not_divided_are_refused(dtype, most):
    """Each code from 1 on would count as white."""
    for call in (response_by_name("srgb").encode, response_by_name("srgb").decode):
        with pytest.raises(TypeError, match=rf"takes floats, not {dtype.__name__}; divide codes by {most}"):
            call(np.array([0, 128, most], dtype))
        assert call([0, 1]) == pytest.approx([0, 1])
