"""The noise of relocation: its size, its shape, and that it repeats."""

import math

import torch

from sehdr_warp.splatting import add_exploration_noise

COUNT, STRENGTH = 200_000, 0.5


def noise(device, opacity, seed=3, quaternion=(1.0, 0.0, 0.0, 0.0), scales=(0.3, 0.1, 0.02)):
    """[COUNT, 3] what is added to positions at the origin."""
    means = torch.zeros(COUNT, 3, device=device)
    add_exploration_noise(
        means,
        torch.tensor(scales, device=device).log().repeat(COUNT, 1),
        torch.tensor(quaternion, device=device).repeat(COUNT, 1),
        torch.full((COUNT,), math.log(opacity / (1 - opacity)), device=device),
        strength=STRENGTH,
        seed=seed,
    )
    return means.cpu()


def test_it_is_normal_and_shaped_by_the_covariance(device):
    drawn = noise(device, 0.001)
    # Equation 8: the sigmoid of 100 (0.005 - 0.001), times R S S R^T.
    expected = STRENGTH / (1 + math.exp(-0.4)) * torch.tensor([0.09, 0.01, 0.0004])
    torch.testing.assert_close(drawn.std(0), expected, rtol=0.02, atol=0)
    assert (drawn.mean(0).abs() < 5 * expected / COUNT**0.5).all()
    unit = drawn / drawn.std(0)
    assert abs(float((unit**4).mean()) - 3) < 0.1 and (unit.T @ unit / COUNT - torch.eye(3)).abs().max() < 0.02


def test_it_turns_with_the_gaussian(device):
    half = math.sqrt(0.5)
    turned = noise(device, 0.001, quaternion=(2 * half, 0.0, 0.0, 2 * half))  # a quarter turn about z, of length 2
    torch.testing.assert_close(turned.std(0), noise(device, 0.001).std(0)[[1, 0, 2]], rtol=0.02, atol=0)


def test_the_opaque_stay(device):
    assert noise(device, 0.5).abs().max() < 1e-12
    assert noise(device, 1 - 1e-7, scales=(1e30, 1.0, 1e-30)).abs().max() == 0


def test_it_repeats_with_the_seed_whatever_the_threads(device, monkeypatch):
    monkeypatch.setenv("SEHDR_THREADS", "1")
    one = noise(device, 0.002)
    monkeypatch.setenv("SEHDR_THREADS", "3")
    assert torch.equal(one, noise(device, 0.002))
    torch.testing.assert_close(one, noise("cpu", 0.002), rtol=1e-4, atol=1e-7)
    assert not torch.equal(one, noise(device, 0.002, seed=4))


def test_no_gaussians(device):
    empty = torch.zeros(0, 3, device=device)
    add_exploration_noise(empty, empty, torch.zeros(0, 4, device=device), empty[:, 0], strength=1.0, seed=0)
