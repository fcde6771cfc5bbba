"""Functions by a table over the bits of floats."""

import numpy as np

from sehdr_warp.scene.color.srgb_codes import FloatTable


def test_values_are_those_of_the_function_at_nearly_the_same_place():
    values = np.exp(np.random.default_rng(0).uniform(np.log(1e-7), np.log(1e5), (40, 25, 3))).astype(np.float32)
    looked_up = FloatTable(lambda value: value**0.5)(values)
    assert looked_up.shape == values.shape and looked_up.dtype == np.float32
    np.testing.assert_allclose(looked_up, np.sqrt(values), rtol=4e-5)


def test_white_and_ends_are_exact_and_codes_nearly():
    table = FloatTable(lambda value: 65535 * np.clip(value, 0, 1), np.uint16)
    values = np.array([1, 2, 7.3, 1e9, np.inf, 0, -0.0, -3, 1e-30], np.float32)
    assert table(values).tolist() == [65535] * 5 + [0] * 4
    np.testing.assert_allclose(table(np.array([0.5, 1 - 2e-5], np.float32)), [32768, 65534], atol=2)
