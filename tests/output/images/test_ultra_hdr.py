"""Ultra HDR pictures as others read them: libultrahdr the light, Pillow the picture and the index."""

import io

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.output.images.display import encode_srgb
from sehdr_warp.output.images.ultra_hdr import MOST_STOPS, ultra_hdr

X, Y = np.meshgrid(np.linspace(-5, 5, 256), np.linspace(0, 1, 192))
LIGHT = (2.0**X)[..., None] * (1 - 0.3 * Y[..., None] * [0, 0.5, 1])
LOOKS = {
    "clipped": encode_srgb(LIGHT),
    "contrast": np.clip(1.1 * LIGHT**0.6 - 0.05, 0, 1),
    "black": np.zeros_like(LIGHT),
}


@pytest.mark.parametrize("look", LOOKS)
def test_the_light_is_kept_whatever_the_plain_picture(look):
    imagecodecs = pytest.importorskip("imagecodecs")
    ratio = imagecodecs.ultrahdr_decode(ultra_hdr(LIGHT, LOOKS[look])).astype(np.float64)[..., :3] / LIGHT
    for column in range(8, 248, 16):
        np.testing.assert_allclose(np.median(ratio[:, column : column + 16], axis=(0, 1)), 1, atol=0.02)


def test_the_plain_picture_and_the_index():
    data = ultra_hdr(LIGHT, LOOKS["contrast"])
    picture = Image.open(io.BytesIO(data))
    np.testing.assert_allclose(np.asarray(picture) / 255, LOOKS["contrast"], atol=0.03)
    index = picture._getmp()
    first, second = index[0xB002]
    at = data.index(b"MPF\0") + 4 + second["DataOffset"]
    assert index[0xB001] == 2 and first["Size"] == at and at + second["Size"] == len(data)
    gains = Image.open(io.BytesIO(data[at:]))
    assert gains.size == picture.size and b'Item:Length="%d"' % second["Size"] in data


def test_brighter_light_than_the_most_is_shown_at_that():
    imagecodecs = pytest.importorskip("imagecodecs")
    light = np.full((32, 32, 3), 1000.0)
    decoded = imagecodecs.ultrahdr_decode(ultra_hdr(light, np.ones_like(light))).astype(np.float64)[..., :3]
    np.testing.assert_allclose(decoded, 2**MOST_STOPS, rtol=0.02)
    dark = imagecodecs.ultrahdr_decode(ultra_hdr(0 * light, 0 * light)).astype(np.float64)[..., :3]
    np.testing.assert_allclose(dark, 0, atol=1e-3)
