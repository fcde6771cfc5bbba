"""Pixels are drawn where a picture differs from its photo, and nowhere else."""

import numpy as np
import pytest
import torch

from sehdr_warp.rasterizer.losses.code_residual import code_tensor, sample_residual_pixels

SIZE = 24, 18  # At which pixels are told, of a photo of 12 x 9


def sampled_pixels(image, codes, device, *, index=None, mask=None, count=4000):
    uniform = torch.from_numpy(np.random.default_rng(0).random(count)).to(device)
    inputs = image.to(device), code_tensor(codes, device), index, mask, uniform, 3, SIZE
    pixels, meant = (values.cpu() for values in sample_residual_pixels(*inputs, least=0.02))
    assert (pixels[:, 0] == 3).all() and pixels[:, 1:].min() >= 2
    assert pixels[:, 1].max() < SIZE[0] - 2 and pixels[:, 2].max() < SIZE[1] - 2
    return pixels[:, 1:], meant


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_draws_follow_the_squares_of_errors(device, dtype):
    white = np.iinfo(dtype).max
    codes = np.full((2, 9, 12, 3), white // 2, dtype)
    image = torch.full((9, 12, 3), (white // 2) / white)
    image[4, 3] += 0.3
    image[6, 8] += 0.1
    image[2, 2] += 0.015
    codes[1, 7, 9], image[7, 9] = white, 40.0
    pixels, meant = sampled_pixels(image, codes, device, index=torch.tensor([1], device=device))
    assert meant.all()
    assert {tuple(pixel) for pixel in pixels.tolist()} == {(7, 9), (17, 13)}
    part = (pixels == torch.tensor([7, 9])).all(1).float().mean()
    assert abs(float(part) - 0.9) < 0.02


def test_masked_errors_and_those_at_the_border_are_not_meant(device):
    codes, image = np.zeros((9, 12, 3), np.uint8), torch.zeros(9, 12, 3)
    image[4, 3], image[0, 0], image[5, 5] = 0.5, 0.5, 0.5
    mask = torch.ones(9, 12, 1, device=device)
    mask[5, 5] = 0
    pixels, meant = sampled_pixels(image, codes, device, mask=mask)
    assert 0.4 < meant.float().mean() < 0.6
    assert {tuple(pixel) for pixel in pixels[meant].tolist()} == {(7, 9)}


@pytest.mark.parametrize("light", [float("inf"), 1e38, -1e38])
def test_light_out_of_range_counts_as_white_or_black(device, light):
    codes, image = np.zeros((9, 12, 3), np.uint8), torch.full((9, 12, 3), -float("inf"))
    image[4, 3] = light
    pixels, meant = sampled_pixels(image, codes, device)
    assert meant.all() == (light > 0)
    assert light < 0 or {tuple(pixel) for pixel in pixels.tolist()} == {(7, 9)}


def test_where_all_is_explained_nothing_is_meant(device):
    assert not sampled_pixels(torch.zeros(9, 12, 3), np.zeros((9, 12, 3), np.uint8), device)[1].any()
