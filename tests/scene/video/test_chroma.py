"""Chroma at full size against the chroma from which it was averaged."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, zoom

from sehdr_warp.scene.video.chroma import upsample_chroma

CENTER = (0.5, 0.5)


def averaged(chroma):
    return chroma.reshape(chroma.shape[0] // 2, 2, chroma.shape[1] // 2, 2, -1).mean((1, 3))


def plain(chroma):
    return np.stack([zoom(part, 2, order=3, mode="nearest", grid_mode=True) for part in np.moveaxis(chroma, 2, 0)], 2)


def error(upsampled, expected):
    return float(np.sqrt(np.mean((upsampled - expected)[8:-8, 8:-8] ** 2)))


def surfaces(noise=0.0):
    """[128, 128] luma of four painted surfaces with fine dots, and [128, 128, 2] chroma in proportion to it."""
    random = np.random.default_rng(0)
    luma = 0.5 + 0.25 * np.sign(gaussian_filter(random.standard_normal((128, 128)), 1.5))
    paint = np.array([[[0.3, -0.1], [-0.2, 0.2]], [[0.1, 0.3], [-0.3, -0.2]]]).repeat(64, 0).repeat(64, 1)
    chroma = paint * luma[..., None]
    luma, stored = (values + noise * random.standard_normal(values.shape) for values in (luma, chroma))
    return luma.astype(np.float32), chroma, averaged(stored).astype(np.float32)


@pytest.mark.parametrize("noise, most", [(0.0, 0.5), (0.01, 0.6), (0.04, 0.8)])
def test_chroma_follows_luma(noise, most):
    luma, chroma, small = surfaces(noise)
    assert error(upsample_chroma(luma, small, CENTER), chroma) < most * error(plain(small), chroma)


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.01, 0.03])
def test_flat_areas_stay_as_even_as_plain_interpolation_makes_them(noise):
    random = np.random.default_rng(0)
    luma = (0.4 + noise * random.standard_normal((256, 256))).astype(np.float32)
    small = (0.1 + noise / 2 * random.standard_normal((128, 128, 2))).astype(np.float32)
    upsampled = upsample_chroma(luma, small, CENTER)
    assert error(upsampled, 0.1) <= error(plain(small), 0.1) + 1e-6


@pytest.mark.parametrize(
    "shape, offsets", [((75, 61), (0.5, 0.0)), ((75, 61), (None, 0.5)), ((2, 2), (1.0, 0.5)), ((1300, 9), (0.0, 0.0))]
)
def test_odd_sizes_and_one_halved_axis(shape, offsets):
    rows, columns = np.indices(shape).astype(np.float32)
    ramp = np.stack([rows, columns], 2) / 2000
    steps = [1 if offset is None else 2 for offset in offsets]
    small = np.indices([-(-size // step) for size, step in zip(shape, steps, strict=True)]).astype(np.float32)
    places = [place * step + (offset or 0) for place, step, offset in zip(small, steps, offsets, strict=True)]
    upsampled = upsample_chroma(np.full(shape, 0.5, np.float32), np.stack(places, 2) / 2000, offsets)
    assert upsampled.shape == (*shape, 2) and upsampled.dtype == np.float32
    np.testing.assert_allclose(upsampled, ramp, atol=1.1 / 2000)
    inside = tuple(slice(4, -4) for _ in shape)
    if min(shape) > 8:
        np.testing.assert_allclose(upsampled[inside], ramp[inside], atol=3e-5)
