"""Color models: start values that invert them, and colors that stay finite."""

import math

import numpy as np
import pytest
import torch

from sehdr_warp.model.color_models import LOG_EXPOSURE_LIMIT, make_color_model
from sehdr_warp.response import response_by_name


def test_colors_of_the_log_model_stay_finite_and_nan_stays_nan(device):
    limit = LOG_EXPOSURE_LIMIT
    sums = torch.tensor([[-2 * limit, 2 * limit, math.inf], [-math.inf, 0.0, math.nan]], device=device).requires_grad_()
    colors = make_color_model("log").colors(sums)
    colors.sum().backward()
    assert colors[0].tolist() == pytest.approx([math.exp(-limit), math.exp(limit), math.exp(limit)], rel=1e-4)
    assert colors[1, 1].item() == 1.0 and math.isnan(colors[1, 2].item()) and sums.grad is not None
    assert sums.grad[0].tolist() == [0, 0, 0] and sums.grad[1, :2].tolist() == [0, 1]


@pytest.mark.parametrize("radiance", ["log", "linear"])
def test_brighter_values_have_brighter_colors(radiance):
    model, factors = make_color_model(radiance), torch.tensor([[1.0, 3.0, 0.5]], dtype=torch.float64)
    values = torch.from_numpy(model.start(np.array([[0.2, 0.5, 0.9]]), response_by_name("srgb")))
    brighter = model.colors(model.brighten(values, factors.log()))
    torch.testing.assert_close(brighter, factors * model.colors(values), rtol=1e-6, atol=0)


@pytest.mark.parametrize("radiance", ["log", "linear", "display"])
def test_start_colors_invert_the_color_model(radiance):
    model, srgb, encoded = make_color_model(radiance), response_by_name("srgb"), np.array([[0.2, 0.5, 0.9]])
    colors = model.colors(torch.from_numpy(model.start(encoded, srgb)))
    colors = colors if model.display_referred else srgb.encode(colors)
    np.testing.assert_allclose(colors, encoded, atol=1e-6)
    # Black and white say a bound only; their start values are finite and inside it.
    assert np.isfinite(model.start(np.array([[0.0, 1.0, 0.5]]), response_by_name("hdr-nerf"))).all()
