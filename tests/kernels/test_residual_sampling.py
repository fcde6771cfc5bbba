"""Pixels are drawn where a picture differs from its photo, and nowhere else."""

import numpy as np
import pytest
import torch

from sehdr_warp.rasterizer.losses.code_residual import code_tensor, sample_residual_pixels

LEAST = 0.02
SIZE = 24, 18  # In whose pixels draws are returned; the photo has 12 x 9


def sampled_pixels(image, codes, device, *, index=None, mask=None, count=4000):
    uniform = torch.from_numpy(np.random.default_rng(0).random(count)).to(device)
    inputs = image.to(device), code_tensor(codes, device), index, mask, uniform, 3, SIZE
    pixels, meant = (values.cpu() for values in sample_residual_pixels(*inputs, least=LEAST))
    assert (pixels[:, 0] == 3).all() and pixels[:, 1:].min() >= 2
    assert pixels[:, 1].max() < SIZE[0] - 2 and pixels[:, 2].max() < SIZE[1] - 2
    return pixels[:, 1:], meant


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_draws_are_those_by_squares_of_errors_in_float64(device, dtype, masked):
    rng, white = np.random.default_rng(1), np.iinfo(dtype).max
    codes, image = rng.integers(0, white + 1, (2, 9, 12, 3)).astype(dtype), rng.uniform(-0.3, 1.4, (9, 12, 3))
    image[:, ::2] = codes[1, :, ::2] / white + 0.03 * rng.uniform(
        -1, 1, (9, 6, 3)
    )  # About half are not above the least
    mask = rng.uniform(0, 1, (9, 12, 1)) if masked else np.ones((9, 12, 1))
    errors = (np.abs(image.clip(0, 1) - codes[1] / white).mean(2) * mask[..., 0]).reshape(-1)
    steps = np.where(errors > LEAST, errors**2, 0).cumsum()
    draws = np.random.default_rng(0).random(4000) * steps[-1]
    places = np.searchsorted(steps, draws)
    expected = np.stack([places % 12, places // 12], 1) * 2 + 1
    within = np.clip(expected, 2, np.array(SIZE) - 3)
    inputs = torch.from_numpy(image).float(), codes, device
    options = {"mask": torch.from_numpy(mask).float().to(device) if masked else None}
    pixels, meant = sampled_pixels(*inputs, index=torch.tensor([1], device=device), **options)
    sure = np.abs(steps[:, None] - draws).min(0) > 1e-6 * steps[-1]
    assert sure.mean() > 0.99 and 0.5 < meant.float().mean() < 1
    np.testing.assert_array_equal(pixels[sure], within[sure])
    np.testing.assert_array_equal(meant[sure], (within == expected).all(1)[sure])


@pytest.mark.parametrize("light", [float("inf"), 1e38, -1e38])
def test_light_out_of_range_counts_as_white_or_black(device, light):
    codes, image = np.zeros((9, 12, 3), np.uint8), torch.full((9, 12, 3), -float("inf"))
    image[4, 3] = light
    pixels, meant = sampled_pixels(image, codes, device)
    assert meant.all() == (light > 0)
    assert light < 0 or {tuple(pixel) for pixel in pixels.tolist()} == {(7, 9)}


def test_where_all_is_explained_nothing_is_meant(device):
    assert not sampled_pixels(torch.zeros(9, 12, 3), np.zeros((9, 12, 3), np.uint8), device)[1].any()
