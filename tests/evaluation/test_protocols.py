"""Protocols of evaluation: which errors of scale each ignores, and what the others cost."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sehdr_warp.evaluation.metrics import psnr
from sehdr_warp.evaluation.protocols import PROTOCOLS, fit_scale, normalize, tone_map, tone_mapped_psnr


def radiance(seed=0, shape=(40, 50, 3), decades=3.0):
    """Log-uniform values with a maximum of 30."""
    values = 10 ** (
        decades * (torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1)
    )
    return 30 * values / values.max()


def figure(protocol, prediction, truth, scale=1.0):
    return tone_mapped_psnr(protocol, *tone_map(protocol, *normalize(protocol, prediction, truth, scale=scale)))


@pytest.mark.parametrize("factor, decibels", [(1.1, 39.0), (1.5, 26.5), (2.0, 21.8), (4.0, 15.8)])
def test_an_error_of_scale_costs_under_gt_max_what_the_mu_law_says(factor, decibels):
    """Down to: bright values pay log(factor) / log(5001) each, values near 1 / 5000 of the maximum less."""
    truth = radiance(decades=1.0)
    value = figure("gt-max", truth / factor, truth)
    assert decibels - 0.1 < value < decibels + 0.5


def test_self_max_cuts_the_truth_down_to_codes_and_averages_channels():
    truth, prediction = radiance(1), radiance(2) * 5
    a, b = tone_map("self-max", *normalize("self-max", prediction, truth))
    codes = b * 255
    assert torch.allclose(codes, codes.round(), atol=1e-9) and not torch.allclose(a * 255, (a * 255).round(), atol=1e-2)
    exact = torch.log1p(5000 * truth / truth.max()) / math.log(5001)
    assert ((exact - b) >= -1e-10).all() and ((exact - b) < 1 / 255).all()
    channels = [10 * math.log10(1 / float(((a - b)[..., c] ** 2).mean())) for c in range(3)]
    assert tone_mapped_psnr("self-max", a, b) == pytest.approx(sum(channels) / 3, abs=1e-9)


def test_what_each_protocol_forgives():
    truth, prediction = radiance(3), radiance(3) * (1 + 0.05 * torch.rand(40, 50, 3, dtype=torch.float64))
    for factor in (0.01, 3.0):
        scaled = prediction * factor
        assert figure("self-max", scaled, truth) == pytest.approx(figure("self-max", prediction, truth), abs=1e-9)
        scale, before = fit_scale([(scaled, truth, None, None)]), fit_scale([(prediction, truth, None, None)])
        assert figure("aligned", scaled, truth, scale) == pytest.approx(
            figure("aligned", prediction, truth, before), abs=1e-6
        )
        assert figure("gt-max", scaled, truth) < figure("gt-max", prediction, truth) - 5
    assert figure("aligned", prediction, truth, 1.0) == figure("gt-max", prediction, truth)


def test_the_scale_stands_up_to_a_third_of_wrong_pixels():
    truth = radiance(6)
    prediction = truth / 2.5 * torch.exp(0.02 * torch.randn(truth.shape, dtype=torch.float64))
    prediction[:13] = truth[:13].clamp(max=0.5)
    prediction[13:15] = 0
    assert fit_scale([(prediction, truth, None, None)]) == pytest.approx(2.5, rel=0.02)


def test_clipped_pixels_vote_where_nothing_else_can():
    """Four fifths of the picture clip, and their light is guessed four times too low: the rest tells the scale."""
    truth = radiance(9)
    prediction, photo = truth / 2, torch.full((40, 50, 3), 0.5)
    prediction[:32], photo[:32] = truth[:32] / 8, 1.0
    assert fit_scale([(prediction, truth, None, photo)]) == pytest.approx(2.0)
    # Ten pixels are too few to decide alone; neither are a mask's holes.
    photo[32:], photo[39, 40:] = 1.0, 0.5
    assert fit_scale([(prediction, truth, None, photo)]) == pytest.approx(8.0)
    mask = torch.zeros(40, 50)
    mask[39] = 1
    assert fit_scale([(prediction, truth, mask, photo)]) == pytest.approx(2.0)


def test_masked_pixels_have_no_vote_and_no_maximum():
    truth, mask = radiance(7), torch.ones(40, 50)
    prediction = truth / 2
    truth, prediction = truth.clone(), prediction.clone()
    truth[:30], mask[:30] = 1e6, 0
    assert fit_scale([(prediction, truth, mask, None)]) == pytest.approx(2.0)
    for protocol in PROTOCOLS:
        a, b = normalize(protocol, prediction, truth, mask)
        assert b[30:].max().item() == 1.0
        assert a[30:].max().item() == pytest.approx(1.0 if protocol == "self-max" else 0.5)


values = st.floats(width=32, allow_nan=True, allow_infinity=True)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(values, min_size=12, max_size=12), st.sampled_from(PROTOCOLS))
def test_any_prediction_has_a_figure(numbers, protocol):
    prediction = torch.tensor(numbers).reshape(2, 2, 3)
    truth = torch.linspace(0.0, 4.0, 12).reshape(2, 2, 3)
    ours, reference = tone_map(protocol, *normalize(protocol, prediction, truth))
    assert ours.shape == reference.shape == (2, 2, 3)
    assert bool(((reference >= 0) & (reference <= 1)).all())
    inside = ours[~ours.isnan()]
    assert bool(((inside >= 0) & (inside <= 1)).all())
    if bool(prediction.isfinite().all()):
        assert not bool(ours.isnan().any())
        assert psnr(ours, reference) >= 0
    scale = fit_scale([(prediction, truth, None, None)])
    assert scale is None or scale > 0


def test_black_images_stay_black():
    black, truth = torch.zeros(5, 5, 3), radiance(8, (5, 5, 3))
    for protocol in PROTOCOLS:
        for prediction, target in ((black, truth), (truth, black), (black, black)):
            a, b = tone_map(protocol, *normalize(protocol, prediction, target))
            assert torch.isfinite(a).all() and torch.isfinite(b).all()
    assert fit_scale([(black, truth, None, None)]) is None and fit_scale([]) is None
