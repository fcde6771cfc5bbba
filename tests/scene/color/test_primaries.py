"""Primaries and curves of color spaces."""

import numpy as np
import pytest

from sehdr_warp.scene.color.primaries import REC709, linear_to_srgb, matrix_to_rec709, srgb_to_linear


def test_curves_and_primaries():
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-6)
    np.testing.assert_array_equal(matrix_to_rec709(REC709), np.eye(3))
    np.testing.assert_allclose(matrix_to_rec709((0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)).sum(1), 1)
    for bad in ((0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.3127, 0.329), (0.0,) * 8, (float("nan"),) * 8):
        with pytest.raises(ValueError, match="span no colors"):
            matrix_to_rec709(bad)
