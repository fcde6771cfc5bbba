"""Metrics under NaN, infinite and huge pixels: the documented value or NaN for the figure, never an exception."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sehdr_warp.evaluation.metrics import psnr
from sehdr_warp.evaluation.protocols import PROTOCOLS, fit_scale, tone_map

values = st.floats(width=32, allow_nan=True, allow_infinity=True)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(values, min_size=12, max_size=12), st.sampled_from(PROTOCOLS))
def test_any_prediction_has_a_figure(numbers, protocol):
    prediction = torch.tensor(numbers).reshape(2, 2, 3)
    truth = torch.linspace(0.0, 4.0, 12).reshape(2, 2, 3)
    ours, reference = tone_map(protocol, prediction, truth)
    assert ours.shape == reference.shape == (2, 2, 3)
    assert bool(((reference >= 0) & (reference <= 1)).all())
    inside = ours[~ours.isnan()]
    assert bool(((inside >= 0) & (inside <= 1)).all())
    if bool(prediction.isfinite().all()):
        assert not bool(ours.isnan().any())
        assert psnr(ours, reference) >= 0
    scale = fit_scale([(prediction, truth, None, None)])
    assert scale is None or scale > 0 or math.isnan(scale)


@pytest.mark.parametrize("poison", [math.nan, math.inf, 3e38])
def test_a_poisoned_pixel_outside_the_mask_changes_nothing(poison):
    image, truth = torch.rand(2, 20, 20, 3, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(20, 20)
    mask[0, 0] = 0
    spoiled = image.clone()
    spoiled[0, 0] = poison
    assert psnr(spoiled, truth, mask) == psnr(image, truth, mask)
