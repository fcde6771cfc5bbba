"""Display values and the gain to middle grey."""

import numpy as np
import pytest

from sehdr_warp.output.images.display import display_gain, encode_srgb
from sehdr_warp.response import response_by_name
from sehdr_warp.response.learned import ToneMapper


def test_srgb_matches_colour_science():
    import colour

    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(encode_srgb(values), colour.models.eotf_inverse_sRGB(values), atol=1e-6)


def test_middle_grey_of_the_photo_is_shown_as_middle_grey():
    assert display_gain(response_by_name("srgb")) == pytest.approx(1, rel=1e-4)
    for response in (response_by_name("hdr-nerf"), ToneMapper()):
        grey = response.encode(np.full((1, 3), 0.18 / display_gain(response)))
        assert grey[0, 1] == pytest.approx(0.4614, abs=1e-3)
