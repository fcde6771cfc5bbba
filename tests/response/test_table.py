"""Curves through samples: repairs, flat parts, any samples at all."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sehdr_warp.errors import InputError
from sehdr_warp.response.table import FLAT_TILT, TabulatedResponse


def test_noise_and_disorder_are_repaired_and_noted():
    exposures = np.linspace(0, 1, 500)
    noisy = (exposures**0.5 + np.random.default_rng(0).normal(0, 0.01, 500)).clip(0, 1)
    curve = TabulatedResponse("noisy", exposures, noisy)
    assert "fall" in curve.notes[0]
    encoded = curve.encode(exposures)
    assert (np.diff(encoded[exposures < curve.clip_exposure]) > 0).all()
    assert abs(encoded - exposures**0.5).max() < 0.04
    assert TabulatedResponse("clean", exposures, exposures).notes == ()
    shuffled = TabulatedResponse("shuffled", [1.0, 0.0, 0.5, 0.5], [1.0, 0.0, 0.6, 0.8])
    assert "sorted" in shuffled.notes[0] and shuffled.encode(0.5) == pytest.approx(0.7, abs=1e-4)


def test_flat_parts():
    exposures = np.linspace(0, 1, 1001)
    values = np.interp(exposures, [0, 0.1, 0.4, 0.5, 0.8, 0.9, 1], [0.05, 0.05, 0.5, 0.5, 0.9, 1, 1])
    curve = TabulatedResponse("flat", exposures, values)
    assert curve.decode(0.5) == pytest.approx(0.45, abs=1e-3)  # Within: the middle.
    assert curve.decode(1.0) == pytest.approx(0.9, abs=1e-9)  # At the top: where clipping begins.
    assert curve.decode(0.05) == 0.0 and curve.slope(0.05) > 0  # At black: from 0, and not without a gradient.
    assert abs(curve.encode(exposures) - values).max() <= FLAT_TILT + 1e-12
    assert curve.notes == ()


ROW = st.tuples(st.floats(0, 1e6, width=32), st.floats(0, 1))


@settings(deadline=None, max_examples=60)
@example([(0.0, 0.0), (5941.0, 0.0), (159959.0, 1.0)])
@example([(0.0, 0.0), (1.0, 0.9999999999999999), (2.0, 1.0)])
@example([(0.0, 0.0), (1.0, 1e-16), (2.0, 0.5), (3.0, 0.5 + 1e-15), (4.0, 1.0)])
@given(st.lists(ROW, min_size=3, max_size=300, unique_by=lambda row: row[0]))
def test_any_table_becomes_an_invertible_curve_or_an_input_error(rows):
    exposures, values = np.array(rows).T
    try:
        curve = TabulatedResponse("any", exposures, values)
    except InputError as error:
        assert "rises by only" in str(error) or "cannot be computed with" in str(error)
        return
    light_levels = np.linspace(curve.black, curve.peak, 200)
    decoded = curve.decode(light_levels)
    assert (np.diff(decoded) >= 0).all() and decoded[0] >= 0 and decoded[-1] == pytest.approx(curve.clip_exposure)
    encoded = curve.encode(np.linspace(0, curve.clip_exposure * 1.5, 500))
    assert (np.diff(encoded) >= -1e-12).all() and encoded.min() >= 0 and encoded.max() <= 1
    np.testing.assert_allclose(curve.encode(decoded), light_levels, atol=1e-6)
