import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sehdr_warp.scene.images.downsampling import area_average


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.data())
def test_area_average_is_exact(width, height, data):
    small = data.draw(st.integers(1, width)), data.draw(st.integers(1, height))
    image = np.random.default_rng(0).random((height, width, 2))
    # Repeating every pixel makes the exact fractional areas whole numbers of samples.
    fine = image.repeat(small[1], axis=0).repeat(small[0], axis=1)
    expected = fine.reshape(small[1], height, small[0], width, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(area_average(image, *small), expected, atol=1e-5)
