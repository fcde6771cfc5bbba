"""The correction that is learned with the scene: increasing, anchored, exactly invertible, and reached by gradients."""

import json

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.response import RefinedResponse, Response, ToneMapper, response_by_name
from sehdr_warp.response.table import TabulatedResponse

STARTS = {
    "srgb": lambda: response_by_name("srgb"),
    "reinhard-gamma": lambda: response_by_name("reinhard-gamma"),
    "offset table": lambda: TabulatedResponse("offset", [0.0, 0.01, 0.1, 0.5, 2.0], [0.02, 0.1, 0.35, 0.7, 0.95]),
}


@pytest.fixture(params=STARTS)
def start(request) -> Response:
    return STARTS[request.param]()


def refined(start: Response, seed: int = 0, strength: float = 1.0) -> RefinedResponse:
    response = RefinedResponse(start)
    with torch.no_grad():
        shape, generator = response.log_densities.shape, torch.Generator().manual_seed(seed)
        response.log_densities.copy_(strength * torch.randn(shape, generator=generator))
    return response


def exposures(response: Response, count: int = 2001) -> np.ndarray:
    return (response.clip_exposure if response.clips else response.white) * np.exp2(np.linspace(-16, 0, count))


def test_begins_as_the_start_curve(start):
    response, x = RefinedResponse(start), exposures(start)
    np.testing.assert_allclose(response.encode(x), start.encode(x), atol=1e-6)
    np.testing.assert_allclose(response.slope(x), start.slope(x), rtol=1e-4)


def test_increases_and_has_an_exact_inverse(start):
    response, x = refined(start), exposures(start)
    values = response.encode(x)
    assert (np.diff(values) > 0).all() and np.abs(values - start.encode(x)).max() > 0.02
    below = values < response.peak - 0.01
    np.testing.assert_allclose(response.decode(values)[below], x[below], rtol=1e-5)


def test_scale_is_anchored(start):
    anchor = start.black + 0.5 * (start.peak - start.black)
    x = start.decode(anchor)
    for seed in range(3):
        assert float(refined(start, seed).encode(x)) == pytest.approx(anchor, abs=1e-6)


def test_ends_stay(start):
    response = refined(start)
    assert float(response.encode(0.0)) == pytest.approx(start.black, abs=1e-6)
    assert response.clip_exposure == start.clip_exposure
    if start.clips:
        assert float(response.encode(start.clip_exposure)) == pytest.approx(start.peak, abs=1e-6)


def test_gradients_are_the_derivatives(start):
    response = refined(start).double()
    x = torch.tensor(exposures(start, 37)[:-1]).requires_grad_()

    def encode(exposure, logs):
        response.log_densities.data.copy_(logs)
        response.log_densities.grad = None
        return response.encode_extended(exposure)

    out = encode(x, response.log_densities.detach().clone())
    weights = torch.linspace(-1, 1, len(out), dtype=torch.float64)
    (out * weights).sum().backward()
    np.testing.assert_allclose(x.grad, weights * response.slope(x.detach()), rtol=1e-6, atol=1e-9)
    gradient, logs = response.log_densities.grad.clone(), response.log_densities.detach().clone()
    for index in range(len(logs)):
        step = torch.zeros_like(logs)
        step[index] = 1e-6
        ends = [float((encode(x.detach(), logs + sign * step) * weights).sum().detach()) for sign in (1, -1)]
        assert float(gradient[index]) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-4, abs=1e-7)


def test_held_back_it_gets_no_gradient(start):
    response = refined(start)
    response.refining = False
    x = torch.full((4,), 0.1, requires_grad=True)
    response.encode_extended(x).sum().backward()
    assert response.log_densities.grad is None and x.grad.abs().min() > 0


def test_beyond_white_a_gradient_is_left():
    response = refined(response_by_name("srgb"))
    x = torch.tensor([1.5, 4.0], requires_grad=True)
    values = response.encode_extended(x)
    values.sum().backward()
    assert (values > 1).all() and values[1] > values[0] and (x.grad > 0).all()


def test_survives_json(start):
    response = refined(start)
    again = Response.from_dict(json.loads(json.dumps(response.to_dict())))
    x = exposures(start)
    np.testing.assert_array_equal(again.encode(x), response.encode(x))


def test_learns_another_curve():
    truth, response = response_by_name("camera"), RefinedResponse(response_by_name("rec709"))
    optimizer = torch.optim.Adam(response.parameters(), lr=0.05)
    scale = float(response.start.decode(0.5)) / float(truth.decode(0.5))
    x = torch.linspace(0.001, 0.9, 400) / scale
    errors = []
    for _ in range(150):
        loss = (response.encode_extended(x * scale) - truth.encode(x)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(float(loss.detach()))
    assert errors[-1] < errors[0] / 20


def test_a_learned_response_is_refused():
    with pytest.raises(SehdrError, match="learned"):
        RefinedResponse(ToneMapper(4))
