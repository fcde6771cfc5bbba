"""Textures of the scenes."""

import numpy as np
import pytest

from scenes.generator import textures

TEXTURES = ("wood", "brick", "checker", "wallpaper", "plaster", "painting", "globe", "ground", "books")


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_are_reflectances_with_detail_and_repeat(name):
    make = getattr(textures, name)
    image, again, other = (make(np.random.default_rng(seed)) for seed in (0, 0, 1))
    assert image.dtype == np.float32 and image.shape[2] == 3
    assert image.min() > 0 and image.max() < 0.9 and image.std() > 0.02
    np.testing.assert_array_equal(image, again)
    assert (image != other).any()
