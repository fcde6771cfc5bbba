"""Small gain maps follow the edges of their photos."""

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene.images.gain_map import GainMap
from sehdr_warp.scene.images.gain_map_parameters import GainMapParameters


@pytest.mark.parametrize("factor", [2, 3])
def test_a_small_gain_map_follows_the_edges_of_its_photo(factor):
    """A window beside a wall: the gain of a pixel of the map that covers both is that of neither."""
    light = np.full((60, 60, 3), 0.2, np.float32)
    light[13:44, 16:47] = 40.0
    gain = np.log2(np.maximum(light, 1)).mean(2) / 6
    small = gain.reshape(60 // factor, factor, 60 // factor, factor).mean((1, 3)).astype(np.float32)
    parameters = GainMapParameters(maximum=6.0, base_offset=0.0, alternate_offset=0.0)
    gain_map = GainMap(small[..., None], parameters)
    error = np.abs(np.log2(gain_map.light(np.minimum(light, 1)) / light))
    plain = np.asarray(Image.fromarray(small).resize((60, 60), Image.Resampling.BILINEAR))
    assert error.mean() < 0.5 * 6 * np.abs(plain - gain).mean() and error[20:37, 23:40].max() < 0.02
