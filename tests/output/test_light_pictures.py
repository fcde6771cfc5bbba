"""Light inside pages."""

import base64

import numpy as np

from sehdr_warp.output.light_pictures import CURVE_SIZE, CURVE_STOPS, curve_table
from sehdr_warp.response.learned import ToneMapper


def test_the_curve_of_pages_is_that_of_a_learned_response():
    stops, response = np.linspace(*CURVE_STOPS, CURVE_SIZE), ToneMapper()
    table = np.frombuffer(base64.b64decode(curve_table(response)), "<f2")
    np.testing.assert_allclose(table, response.encode(2.0 ** stops[:, None].repeat(3, 1))[:, 1], atol=1e-3)
