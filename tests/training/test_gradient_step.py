"""Gradient steps: which Gaussians DropGaussian leaves out of them."""

import pytest
import torch

from sehdr_warp.model.gaussians import moments_of
from sehdr_warp.training.gradient_step import Dropout

from .toy import VARIANTS, make_trainer, quick

ROWS = 100_000


def test_a_growing_share_is_left_out_and_the_mean_stays(device):
    dropout = Dropout(0.4, 3, 1000, torch.device(device))
    for iteration, share in ((1, 0.0004), (500, 0.2), (1000, 0.4)):
        dropout.draw(iteration, ROWS)
        assert float((dropout.factors == 0).float().mean()) == pytest.approx(share, abs=0.005)
        assert float(dropout.factors.mean()) == pytest.approx(1, abs=0.01)
    none = Dropout(0.0, 0, 1000, torch.device(device))
    none.draw(10, ROWS)
    assert none.factors is None


def test_draws_depend_on_seed_and_iteration_alone_and_keep_their_memory(device):
    def factors(seed: int, *iterations: int) -> torch.Tensor:
        dropout = Dropout(0.4, seed, 1000, torch.device(device))
        addresses = set()
        for iteration in iterations:
            dropout.draw(iteration, ROWS)
            addresses.add(dropout.factors.data_ptr())
        assert len(addresses) == 1
        return dropout.factors

    assert torch.equal(factors(1, 600, 700), factors(1, 700))
    assert not torch.equal(factors(1, 700), factors(2, 700))
    assert not torch.equal(factors(1, 700), factors(1, 701))


def test_gaussians_that_are_left_out_get_no_gradient(scene):
    shares = []
    for variant in ("default", "dropout"):
        trainer = make_trainer(scene, VARIANTS[variant])
        trainer.iteration = trainer.total - 1  # With dropout, the last step leaves out half of the Gaussians.
        trainer.step()
        squares = moments_of(trainer.optimizer, trainer.field.gaussians.log_scales)["exp_avg_sq"]
        shares.append(float(squares.any(1).float().mean()))
    assert shares[1] == pytest.approx(0.5 * shares[0], abs=0.1)


def test_gaussians_that_are_nearly_opaque_are_left_out_too(scene):
    """Divided by what is left, their opacities are above 1."""
    config = quick(**{"model.dropout": 0.5, "seed": 2**62})
    trainer = make_trainer(scene, config)
    trainer.field.gaussians.opacity_logits.data.fill_(6.0)
    trainer.iteration = trainer.total - 1
    trainer.step()
    assert trainer.loss < 1
    squares = moments_of(trainer.optimizer, trainer.field.gaussians.harmonics_dc)["exp_avg_sq"]
    assert 0 < float(squares.any(1).float().mean()) < 0.6
