"""Targets of a photo on the scale on which renders are compared with it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.model.renders import PhotoRender
from sehdr_warp.rasterizer.losses.code_residual import code_tensor
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import LossConfig
from sehdr_warp.training.losses import ldr_loss
from sehdr_warp.training.targets import Target, code_scale, mu_of_knee


def images(seed=0, shape=(12, 14, 3)):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)


def target_of(encoded, response=None, *, truth=None, clipping=True, bits=8):
    """The target of encoded values [H, W, 3]: compared as light where a response is given."""
    white = 2**bits - 1
    codes = (encoded.detach().double() * white).round().numpy().astype(np.uint16 if bits == 16 else np.uint8)
    scale = code_scale(white, response, "cpu", clipping=clipping, dtype=encoded.dtype)
    return Target(code_tensor(codes, "cpu"), scale, exposure_truth=truth)


def row(*values):
    """[1, values, 3] of equal channels."""
    return torch.tensor(values).reshape(1, -1, 1).expand(1, len(values), 3).clone()


def test_the_psnr_of_a_step_leaves_out_what_the_mask_does():
    image, _ = images()
    target = target_of(image + 0.1 * (0.5 - image).sign())
    mask = torch.ones(12, 14, 1)
    mask[:, :5] = 0
    hidden = torch.where(mask > 0, image, 1 - image)
    assert target.psnr(image) == pytest.approx(20, abs=0.3)
    assert target.psnr(hidden) < 12 and replace(target, mask=mask).psnr(hidden) == pytest.approx(20, abs=0.3)


def test_a_code_is_worth_the_middle_of_what_it_stands_for():
    response = response_by_name("hdr-nerf")
    scale = code_scale(255, response, "cpu", dtype=torch.float64)
    light = response.white * torch.expm1(scale.table[:, 0] * math.log1p(scale.mu)) / scale.mu
    least, most = (float(response.decode((254 + half) / 255)) for half in (-0.5, 0.5))
    # The curve is so flat there that the code stands for one and a half stops.
    assert light[254].item() == pytest.approx(math.sqrt(least * most), rel=1e-3)
    assert light[128].item() == pytest.approx(float(response.decode(128 / 255)), rel=1e-3)


@pytest.mark.parametrize("largest", [255, 65535])
@pytest.mark.parametrize("clipping", [True, False])
def test_the_ends_stand_for_all_values_beyond_half_an_8_bit_code(largest, clipping):
    table = code_scale(largest, None, "cpu", clipping=clipping, dtype=torch.float64).table
    half = 0.5 / 255
    ends = [[0.0, -math.inf, half], [1.0, 1.0 - half, math.inf]] if clipping else [[0.0] * 3, [1.0] * 3]
    torch.testing.assert_close(table[[0, -1]], torch.tensor(ends, dtype=torch.float64))
    torch.testing.assert_close(table[7], torch.full((3,), 7 / largest, dtype=torch.float64))


@pytest.mark.parametrize("clipping", [True, False])
def test_light_anywhere_within_what_a_code_stands_for_is_as_good_once_it_is_an_interval(clipping):
    response = response_by_name("hdr-nerf")
    places = torch.linspace(253.6, 254.4, 8, dtype=torch.float64).view(1, -1, 1).expand(1, -1, 3)
    light = response.decode(places / 255).requires_grad_()
    target = target_of(torch.full((1, 8, 3), 254 / 255).double(), response, clipping=clipping)
    for wide in (False, clipping):
        loss = ldr_loss(PhotoRender(light, light, light, None, light), target, LossConfig(clipped_smoothness=0.0))
        (slopes,) = torch.autograd.grad(loss, light)
        assert (loss.item() < 1e-12) == wide and bool((slopes == 0).all()) == wide
        target.scale.use_intervals()


@pytest.mark.parametrize(
    "name, code",
    [("srgb", 8), ("hdr-nerf", 8), ("linear", 8), ("gain-map", 0.5), ("colour:S-Log3", 8 + 255 * 95 / 1023)],
)
def test_the_knee_is_at_its_code_above_black(name, code):
    response = response_by_name(name)
    knee = response.white / mu_of_knee(response)
    assert float(response.encode(knee)) * 255 == pytest.approx(code, rel=1e-3)
