"""The learned tone mapper: its shape, its inverse, its gradients, and what a field does with it."""

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.model.renders import CameraTensors
from sehdr_warp.response import Response, ToneMapper, response_by_name
from sehdr_warp.response.learned import EXACT_BELOW
from sehdr_warp.scene import Camera

CAMERA = Camera(16, 12, 15.0, 15.0, 8.0, 6.0, np.eye(4))


@pytest.fixture(scope="module")
def fitted():
    """A tone mapper that has learned HDR-NeRF's curve."""
    mapper, curve = ToneMapper(32, seed=1), response_by_name("hdr-nerf")
    exposures = torch.logspace(-3, 1.5, 300)[:, None].expand(-1, 3)
    optimizer = torch.optim.Adam(mapper.parameters(), lr=0.02)
    for _ in range(300):
        optimizer.zero_grad()
        (mapper.encode(exposures) - curve.encode(exposures)).square().mean().backward()
        optimizer.step()
    return mapper.requires_grad_(False)


def test_it_is_one_perceptron_a_channel_on_the_logarithm():
    mapper = ToneMapper(5, seed=3)
    x = torch.tensor([[0.2, 1.0, 7.0]])
    weights, biases = [list(group) for group in (mapper.weights, mapper.biases)]
    for channel in range(3):
        hidden = (x[0, channel].log() * weights[0][channel, 0] + biases[0][channel, 0]).relu()
        expected = torch.sigmoid(hidden @ weights[1][channel, :, 0] + biases[1][channel, 0, 0])
        torch.testing.assert_close(mapper.encode(x)[0, channel], expected, rtol=1e-4, atol=1e-6)


def test_shapes_kinds_and_ends():
    mapper = ToneMapper(8)
    for shape in ((4, 5, 3), (7, 3), (3,)):
        encoded = mapper.encode(torch.rand(shape))
        assert encoded.shape == shape and bool(((encoded > 0) & (encoded < 1)).all())
        assert mapper.decode(encoded).shape == mapper.slope(torch.rand(shape)).shape == shape
    black = torch.zeros(2, 3, requires_grad=True)
    mapper.encode_extended(black).sum().backward()
    assert bool(torch.isfinite(black.grad).all())
    array = mapper.encode(np.full((2, 3), 0.5))
    assert isinstance(array, np.ndarray) and array.dtype == np.float64 and mapper.decode(array).shape == (2, 3)
    assert mapper.learnable
    np.testing.assert_allclose(np.log(mapper.start_exposures(np.array([[0.1, 0.5, 0.9]]))), [[0.1, 0.5, 0.9]])
    assert not mapper.clips and (mapper.black, mapper.peak) == (0.0, 1.0)


def test_it_learns_a_curve_and_inverts_what_it_learned(fitted):
    exposures = torch.logspace(-2, 1, 50)[:, None].expand(-1, 3)
    encoded = fitted.encode(exposures)
    assert float((encoded - response_by_name("hdr-nerf").encode(exposures)).abs().max()) < 0.03
    torch.testing.assert_close(fitted.decode(encoded), exposures, rtol=0.01, atol=0)
    step = 1e-3 * exposures
    rise = (fitted.encode(exposures + step) - fitted.encode(exposures - step)) / (2 * step)
    # ReLUs have kinks, where the two differ.
    assert float(((fitted.slope(exposures) - rise).abs() < 0.02 * rise).float().mean()) > 0.9


def test_many_exposures_are_encoded_as_few_are(fitted, device):
    mapper = ToneMapper(32).to(device)
    mapper.load_state_dict(fitted.state_dict())
    mapper.requires_grad_(True)
    generator = torch.Generator().manual_seed(0)
    logs = (16 * torch.rand(EXACT_BELOW, 3, generator=generator) - 13).to(device).requires_grad_()
    weights = torch.rand(EXACT_BELOW, 3, generator=generator).to(device)
    results = []
    for parts in (1, 2):
        encoded = torch.cat([mapper.encode_log(part) for part in logs.split(EXACT_BELOW // parts)])
        gradients = torch.autograd.grad((weights * encoded).sum(), [logs, *mapper.parameters()])
        results.append((encoded.detach(), *gradients))
    (encoded, slopes, *ours), (exact, true_slopes, *true) = results
    assert not torch.equal(encoded, exact) and float((encoded - exact).abs().max()) < 1e-3
    assert float((slopes - true_slopes).square().mean().sqrt() / true_slopes.square().mean().sqrt()) < 0.03
    for ours_, true_ in zip(ours, true, strict=True):
        assert float((ours_ - true_).norm() / true_.norm()) < 0.01


def test_seeds_differ_and_descriptions_keep_the_shape():
    first, again, other = (ToneMapper(8, seed=seed) for seed in (1, 1, 2))
    x = torch.rand(4, 3)
    assert torch.equal(first.encode(x), again.encode(x)) and not torch.allclose(first.encode(x), other.encode(x))
    copy = Response.from_dict(other.to_dict())
    copy.load_state_dict(other.state_dict())
    assert torch.equal(copy.encode(x), other.encode(x))
    for width in (0, -1, 2.5, True):
        with pytest.raises(SehdrError, match="width"):
            ToneMapper(width)
    with pytest.raises(SehdrError, match="damaged"):
        Response.from_dict({"kind": "mlp"})


@pytest.mark.parametrize("tone_map", ["pixel", "gaussian"])
def test_a_field_photographs_through_it_and_teaches_it(tone_map, device):
    gaussians = Gaussians.from_points(torch.tensor([[0.0, 0.0, 3.0]]), torch.full((1, 3), -1.0), 0, opacity=0.99)
    gaussians.overwrite({"log_scales": torch.full((1, 3), 4.0), "opacity_logits": torch.full((1,), 12.0)})
    field = RadianceField(gaussians, ToneMapper(8), base_time=0.5, tone_map=tone_map).to(device)
    photo = field.render_photo(CameraTensors.of(CAMERA, device), 2.0, extra_images=frozenset({"exposure"}))
    covered = float(photo.rendering.alpha.detach()[6, 8])
    expected = field.response.encode(torch.full((3,), float(np.exp(-1.0)) * 4.0, device=device)) * covered
    torch.testing.assert_close(photo.encoded[6, 8], expected, rtol=0.02, atol=0)
    photo.encoded.sum().backward()
    assert all(bool(parameter.grad.any()) for parameter in field.response.parameters())
    assert bool(field.gaussians.harmonics_dc.grad.any())


@pytest.mark.parametrize("seed", range(4))
def test_every_channel_starts_rising_in_the_dark_in_the_middle_and_in_the_light(seed):
    log_exposure = torch.tensor([-12.0, -7.0, -0.01, 0.01, 3.0, 8.0])[:, None].expand(-1, 3)
    with torch.no_grad():
        assert (ToneMapper(32, seed).encode_log(log_exposure).logit().diff(dim=0) > 0).all()
