"""NeEF against the paper's equations written out plainly, in its limits, and the table against the exact form."""

import math
from functools import partial
from itertools import pairwise

import pytest
import torch

from sehdr_warp.model.exposure import exposure_times
from sehdr_warp.model.fusion import NeuralExposureFusion
from sehdr_warp.rasterizer.ops.exposure_fusion import fuse_exposures, fusion_weights
from sehdr_warp.response import response_by_name

BASE_TIME = 2.0
RESPONSES = ("gamma-2.2", "reinhard-gamma", "linear", "colour:S-Log3")


def make_fusion(name="gamma-2.2", *, sharpness=1.0, **options) -> NeuralExposureFusion:
    fusion = NeuralExposureFusion(response_by_name(name), exposure_times(BASE_TIME), BASE_TIME, **options).double()
    with torch.no_grad():
        fusion.weights[-1].mul_(sharpness)
    return fusion


def exact(fusion, log_base) -> torch.Tensor:
    """The equations for each Gaussian, without the table."""
    encoded = torch.stack(
        [fusion.response.encode_extended((log_base + math.log(t / BASE_TIME)).exp()) for t in fusion.times]
    )
    (inner, outer), (inner_bias, outer_bias) = fusion.weights, fusion.biases
    weights = fusion_weights(encoded, fusion.log_sigma, inner, inner_bias, outer, outer_bias)
    return fusion.radiance_scale * (weights * encoded).sum(dim=0)


def log_radiance(fusion, count=400, seed=0) -> torch.Tensor:
    """[count, 3] from far below black to far beyond white at every bracket."""
    generator = torch.Generator().manual_seed(seed)
    stops = 48 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 34
    return stops * math.log(2) + math.log(fusion.response.white)


def plain_neef(fusion, log_base):
    """The equations of section 3.3, one Gaussian, channel and exposure at a time."""
    fused = torch.zeros_like(log_base)
    for i in range(len(log_base)):
        for c in range(3):
            encoded, logits = [], []
            for time in fusion.times:
                radiance = torch.exp(log_base[i, c]) * time / BASE_TIME
                f = fusion.response.encode_extended(radiance)
                gamma = torch.exp(-((f - 0.5) ** 2) / (2 * torch.exp(fusion.log_sigma[c]) ** 2))
                hidden = torch.stack([gamma, f])
                for layer, (weight, bias) in enumerate(zip(fusion.weights, fusion.biases, strict=True)):
                    hidden = (hidden.relu() if layer else hidden) @ weight[c] + bias[c, 0]
                encoded.append(f)
                logits.append(hidden[0] * gamma)
            weights = torch.exp(torch.stack(logits)) / torch.exp(torch.stack(logits)).sum()
            fused[i, c] = fusion.radiance_scale * (weights * torch.stack(encoded)).sum()
    return fused


@pytest.mark.parametrize("name", RESPONSES)
def test_exact_is_the_papers_equations(name):
    fusion = make_fusion(name, width=8, sharpness=5, radiance_scale=3.0)
    log_base = log_radiance(fusion, 12)
    torch.testing.assert_close(exact(fusion, log_base), plain_neef(fusion, log_base), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sigma", [1e-30, 0.2, 1e30])
@pytest.mark.parametrize("output_bias", [0.0, 1e4, -1e4])
@pytest.mark.parametrize("evaluate", [exact, NeuralExposureFusion.forward])
def test_extremes_stay_finite(device, dtype, sigma, output_bias, evaluate):
    fusion = make_fusion("gamma-2.2").to(device, dtype)
    with torch.no_grad():
        fusion.log_sigma.fill_(math.log(sigma))
        fusion.biases[-1].fill_(output_bias)
    # The third is exactly the radiance with f = 0.5, where the deviation is 0 however small sigma is.
    exposures = [1e-30, 1e-12, 0.5**2.2, 1.0, 1e9, 1e30]
    log_base = (
        torch.tensor(exposures, dtype=torch.float64).log()[:, None].expand(-1, 3).to(device, dtype).requires_grad_()
    )
    fused = evaluate(fusion, log_base)
    fused.sum().backward()
    assert fused.isfinite().all() and (fused >= 0).all()
    for tensor in (log_base, *fusion.parameters()):
        assert tensor.grad.isfinite().all()


@pytest.mark.parametrize("table", [False, True])
def test_gradients_against_finite_differences(monkeypatch, table):
    monkeypatch.setattr("sehdr_warp.model.fusion.NODES", 64)
    fusion = make_fusion("reinhard-gamma", width=5, sharpness=4)
    if not table:
        fusion.forward = partial(exact, fusion)
    log_base = (torch.rand(3, 3, dtype=torch.float64) * 6 - 4).requires_grad_()
    names, tensors = zip(*fusion.named_parameters(), strict=True)

    def call(log_base, *tensors):
        return torch.func.functional_call(fusion, dict(zip(names, tensors, strict=True)), (log_base,))

    assert torch.autograd.gradcheck(call, (log_base, *tensors), eps=1e-6, atol=1e-8, rtol=1e-5)


@pytest.mark.parametrize("name", RESPONSES)
def test_table_matches_exact(name):
    fusion = make_fusion(name, sharpness=10)
    log_base = log_radiance(fusion, 4000).requires_grad_()
    difference = (fusion(log_base) - exact(fusion, log_base)).detach()
    assert difference.abs().max() < 2e-3, "largest at the kinks of a clipping response"
    assert difference.square().mean().sqrt() < 1e-4
    inputs, expected = (
        torch.autograd.grad(evaluate(log_base).sum(), [log_base, *fusion.parameters()])
        for evaluate in (fusion, partial(exact, fusion))
    )
    for a, b in zip(inputs, expected, strict=True):
        assert (a - b).norm() < 0.06 * b.norm()


def test_nodes_made_while_a_step_is_recorded_are_not_kept(monkeypatch):
    fusion, colours, nodes = make_fusion(), torch.zeros(4, 3, dtype=torch.float64), []
    fuse = "sehdr_warp.model.fusion.fuse_exposures"
    monkeypatch.setattr(
        fuse, lambda encoded, *rest, **scale: nodes.append(encoded) or fuse_exposures(encoded, *rest, **scale)
    )
    values = []
    for is_recorded in (True, True, False, False):
        monkeypatch.setattr("sehdr_warp.model.fusion.is_capturing", lambda device, answer=is_recorded: answer)
        values.append(fusion(colours))
    assert [a is b for a, b in pairwise(nodes)] == [False, False, True]
    assert all(torch.equal(value, values[0]) for value in values)


def test_radiance_scale():
    response = response_by_name("reinhard-gamma")
    log_base = torch.zeros(2, 3, dtype=torch.float64)
    scale = response.white / BASE_TIME
    unit, white = make_fusion("reinhard-gamma"), make_fusion("reinhard-gamma", radiance_scale=scale)
    torch.testing.assert_close(white(log_base), unit(log_base) * response.white / BASE_TIME)
    assert unit(log_base[:0]).shape == (0, 3)
    # The paper's value is at most 1, so at a short exposure a bright pixel is out of reach; scaled, it is not.
    bright = torch.full((1, 3), math.log(1e9), dtype=torch.float64)
    assert response.encode(unit(bright) * 0.125).max() < 0.4
    assert response.encode(white(bright) * BASE_TIME).min() > 1 - 1 / 255
