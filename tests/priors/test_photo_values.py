"""Values of simulated photos: curves, noise, white balance."""

import numpy as np
import torch

from priors.pack import curves
from priors.photo_values import dct, interpolate, inverse, lower_median


def test_curves_are_inverted(tmp_path):
    every = torch.from_numpy(curves(tmp_path / "none.mat")).double()
    exposure = torch.rand(len(every), 3, 50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    encoded = interpolate(every, exposure)
    torch.testing.assert_close(inverse(every, encoded), exposure, rtol=1e-6, atol=1e-7)
    nodes = np.linspace(0, 1, every.shape[1]) ** 3
    for curve, values, light in zip(every, encoded, exposure, strict=True):
        np.testing.assert_allclose(values, np.interp(np.cbrt(light.numpy()), np.cbrt(nodes), curve), atol=1e-9)


def test_cosines_are_orthonormal_and_medians_are_values():
    torch.testing.assert_close(dct(8) @ dct(8).T, torch.eye(8))
    assert lower_median(torch.tensor([[4.0, 1.0, 3.0, 2.0], [5.0, 9.0, 7.0, 9.0]])).tolist() == [[2.0], [7.0]]
