"""Gradients of all parameters in one buffer."""

import torch

from sehdr_warp.rasterizer import HarmonicsGradients
from sehdr_warp.training.flat_gradients import FlatGradients
from sehdr_warp.training.optimizer import make_optimizer

from .toy import VARIANTS, toy_field


def test_gradients_go_through_one_buffer():
    field = toy_field()
    optimizer = make_optimizer(field, VARIANTS["adc"])
    flat, gradients = FlatGradients(optimizer, 0, 1, defer_sh=False), {}
    for name in ("means", "opacity_logits"):
        parameter = getattr(field.gaussians, name)
        gradients[name] = parameter.grad = torch.randn_like(parameter)
    flat.collect(torch.tensor(2.0), torch.tensor(True))
    assert flat.fits(optimizer) and field.gaussians.means.grad is None
    flat.buffer.mul_(0.5)
    loss, overflow, harmonics = flat.distribute()
    assert harmonics is None and loss == 1 and bool(overflow) and field.gaussians.quaternions.grad is None
    for name, gradient in gradients.items():
        assert torch.equal(getattr(field.gaussians, name).grad, gradient / 2)
    # The next step has gradients of other parameters.
    optimizer.zero_grad()
    field.gaussians.quaternions.grad = torch.ones_like(field.gaussians.quaternions)
    flat.collect(torch.tensor(2.0), None)
    flat.distribute()
    assert (field.gaussians.quaternions.grad == 1).all() and field.gaussians.means.grad is None
    field.gaussians.resize(70, optimizer)
    assert not flat.fits(optimizer) and field.gaussians.count == 70


def test_harmonics_go_as_their_factors():
    field, count = toy_field(), 3
    optimizer, means = make_optimizer(field, VARIANTS["adc"]), field.gaussians.means
    ranks = [FlatGradients(optimizer, place, count, defer_sh=True) for place in range(count)]
    factors = [HarmonicsGradients(torch.randn(1, len(means), 3), torch.randn(1, 3), means, 1) for _ in ranks]
    for flat, harmonics in zip(ranks, factors, strict=True):
        means.grad = torch.ones_like(means)
        flat.collect(torch.tensor(2.0), None, harmonics)
    ranks[1].buffer.copy_(torch.stack([flat.buffer for flat in ranks]).mean(0))
    _, _, harmonics = ranks[1].distribute()
    assert harmonics.degree == 1 and ranks[1].buffer.numel() < 4 * count * means.numel() + 11 * len(means)
    assert torch.allclose(harmonics.grad_colors, torch.cat([one.grad_colors for one in factors]) / count)
    assert torch.allclose(harmonics.positions, torch.cat([one.positions for one in factors]))
