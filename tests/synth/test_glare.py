"""Veiling glare of photos of truth."""

import math

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name
from sehdr_warp.synth.expose import expose
from sehdr_warp.synth.glare import MOST_GLARE, PATCH, add_glare
from tests.make_scenes import load

SIZES = [(1, 1), (1, 9), (9, 1), (2, 3), (60, 81), (75, 64)]


def random_light(size, channels=3):
    return 10 ** np.random.default_rng(0).uniform(-3, 4, (*size, channels))


def scattered_directly(light, index):
    """Sum over a picture and its mirror images, pixel by pixel, instead of by a cosine transform."""
    height, width = light.shape
    mirrored = np.block([[light, light[:, ::-1]], [light[::-1], light[::-1, ::-1]]])
    rows, columns = (np.minimum(np.arange(2 * n), 2 * n - np.arange(2 * n)) for n in (height, width))
    square = np.add.outer(rows**2, columns**2).astype(float)
    kernel = np.divide(1, square, out=np.zeros_like(square), where=square > 0)
    kernel *= index / 100 / kernel[square > (PATCH / 2 * math.hypot(height, width)) ** 2].sum()
    result = (1 - kernel.sum()) * light
    for i in range(height):
        for j in range(width):
            result[i, j] += (np.roll(kernel, (i, j), (0, 1)) * mirrored).sum()
    return result


@pytest.mark.parametrize("index", [0.5, 3.0, MOST_GLARE])
@pytest.mark.parametrize("size", SIZES)
def test_glare_moves_light_and_makes_none(size, index):
    light = random_light(size)
    scattered = add_glare(light, index)
    np.testing.assert_allclose(scattered.sum((0, 1)), light.sum((0, 1)), rtol=1e-12)
    assert scattered.min() >= 0 and (size == (1, 1) or scattered.max() < light.max())
    uniform = np.ones((*size, 1))
    np.testing.assert_allclose(add_glare(uniform, index), uniform, rtol=1e-12)


@pytest.mark.parametrize("size", [(7, 5), (6, 9)])
def test_glare_is_a_convolution_of_the_mirrored_picture(size):
    light = random_light(size, channels=1)
    expected = scattered_directly(light[..., 0], 3.0)
    np.testing.assert_allclose(add_glare(light, 3.0)[..., 0], expected, rtol=1e-10, atol=1e-10 * light.max())


@pytest.mark.parametrize("index", [0.5, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("size", [(101, 75), (200, 300), (512, 512)])
def test_a_black_patch_shows_the_index(size, index):
    rows, columns = np.indices(size)
    distance = np.hypot(rows - (size[0] - 1) / 2, columns - (size[1] - 1) / 2)
    field = (distance > PATCH / 2 * math.hypot(*size)).astype(float)[..., None]
    middle = add_glare(field, index)[size[0] // 2, size[1] // 2]
    np.testing.assert_allclose(100 * middle, index, rtol=0.01)


def test_the_halo_falls_by_the_inverse_square_and_grows_with_lamp_and_index():
    lamp = np.zeros((256, 256, 1))
    lamp[128, 128] = 1e6
    halo = add_glare(lamp, 1.0)[128, 128:, 0]
    np.testing.assert_allclose(halo[4] / halo[8], 4.0, rtol=0.02)
    np.testing.assert_allclose(add_glare(lamp, 3.0)[128, 132, 0] / halo[4], 3.0, rtol=1e-6)
    np.testing.assert_allclose(add_glare(3 * lamp, 1.0)[128, 132, 0] / halo[4], 3.0, rtol=1e-6)


def test_glare_of_0_changes_no_bit_and_others_leave_the_truth_alone():
    room, response = load("embedded", max_size=32), response_by_name("srgb")
    before, same, veiled = (expose(room, response, 0.25, **options) for options in ({}, {"glare": 0.0}, {"glare": 3.0}))
    for first, second, third, view in zip(before.views, same.views, veiled.views, room.views, strict=True):
        np.testing.assert_array_equal(first.codes, second.codes)
        np.testing.assert_array_equal(third.hdr, view.hdr)
        expected = response.encode(add_glare(np.maximum(view.hdr.astype(np.float64), 0), 3.0) * 0.25)
        assert np.abs(third.image - expected).max() <= 0.5 / 255 + 1e-5
    light = random_light((8, 8))
    np.testing.assert_array_equal(add_glare(light, 0.0), light)


def test_an_impossible_glare_is_refused_in_a_line():
    light = random_light((8, 8))
    for index in (-1.0, MOST_GLARE + 0.1, math.nan, math.inf):
        with pytest.raises(InputError, match="give 0 to 20"):
            add_glare(light, index)
    light[3, 3, 0] = math.inf
    with pytest.raises(InputError, match="not finite"):
        add_glare(light, 1.0)
