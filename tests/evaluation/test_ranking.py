"""Rank correlation of confidence and errors, for values whose correlation is known."""

import pytest
import torch

from sehdr_warp.evaluation.ranking import ErrorRanking, spearman


def test_spearman_is_that_of_ranks():
    values = torch.tensor([0.1, 0.4, 0.2, 0.9])
    assert spearman(values, values.exp()) == pytest.approx(1.0)
    assert spearman(values, -(values**3)) == pytest.approx(-1.0)
    # Ties share their mean rank: of (1, 2.5, 2.5, 4) and (1, 2, 3, 4).
    assert spearman(torch.tensor([0.0, 1, 1, 2]), torch.arange(4.0)) == pytest.approx(4.5 / (4.5 * 5) ** 0.5)
    assert spearman(torch.ones(4), values) is None


def images(height=16, width=20):
    generator = torch.Generator().manual_seed(2)
    truth = torch.rand(height, width, 3, generator=generator) + 0.1
    stops = torch.rand(height, width, generator=generator) * 2
    stops[:, :12] = 0
    return truth, stops


def test_masked_pixels_do_not_count():
    truth, stops = images()
    prediction = truth * 2 ** stops[..., None]
    mask = torch.ones(16, 20)
    mask[:8] = 0
    prediction[:8] = 1e9
    ranking = ErrorRanking()
    ranking.add(torch.exp2(-stops), prediction, truth, stops == 0, 1e-6, mask)
    assert ranking.result()["pixels"] == 160 and ranking.result()["spearman_log2"] > 0.85


def test_what_cannot_be_ranked_says_why():
    nothing = ErrorRanking().result()
    assert nothing["spearman_log2"] is None and "not measured" in nothing["reason"]
    truth, _ = images()
    ranking = ErrorRanking()
    ranking.add(torch.ones(16, 20), truth, truth, torch.ones(16, 20, dtype=torch.bool), 1e-6)
    assert ranking.result()["spearman_log2"] is None and "one confidence" in ranking.result()["reason"]
