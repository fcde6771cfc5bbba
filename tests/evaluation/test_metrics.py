"""Metrics against analytic values, published values and independent implementations."""

import math

import cv2
import numpy as np
import pytest
import scipy.ndimage
import torch

from sehdr_warp.evaluation.metrics import mu_law, percentile, psnr, pu21_encode, pu21_metrics, region_masks, ssim


def noisy_pair(shape=(48, 61, 3), noise=0.1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(shape, generator=generator)
    return (truth + noise * torch.randn(shape, generator=generator)).clamp(0, 1), truth


def test_mu_law_is_the_papers_equation():
    values = torch.tensor([0.0, 1e-4, 0.01, 0.5, 1.0, -3.0, 7.0], dtype=torch.float64)
    expected = [
        0.0,
        math.log(1.5) / math.log(5001),
        math.log(51) / math.log(5001),
        math.log(2501) / math.log(5001),
        1.0,
        0.0,
        1.0,
    ]
    assert mu_law(values).tolist() == pytest.approx(expected, abs=1e-15)
    assert mu_law(torch.tensor(0.1, dtype=torch.float64), mu=10).item() == pytest.approx(math.log(2) / math.log(11))


def test_psnr_of_a_known_offset():
    truth = torch.full((7, 9, 3), 0.25)
    assert psnr(truth + 0.125, truth) == pytest.approx(20 * math.log10(8), abs=1e-6)
    assert psnr((truth + 0.125) * 255, truth * 255, peak=255.0) == pytest.approx(20 * math.log10(8), abs=1e-6)
    assert psnr(truth, truth) == math.inf


def test_psnr_equals_opencv():
    prediction, truth = noisy_pair()
    assert psnr(prediction, truth) == pytest.approx(cv2.PSNR(prediction.numpy(), truth.numpy(), R=1.0), abs=1e-4)


def test_psnr_of_channels_apart():
    truth = torch.zeros(4, 4, 3)
    prediction = truth + torch.tensor([0.1, 0.01, 0.001])
    assert psnr(prediction, truth, channels_apart=True) == pytest.approx(40.0, abs=1e-5)
    assert psnr(prediction, truth) == pytest.approx(10 * math.log10(3 / 0.010101), abs=1e-5)


def test_masks_weigh_the_pixels():
    prediction, truth = noisy_pair()
    mask = torch.zeros(48, 61)
    mask[5:20, 10:40] = 1
    assert psnr(prediction, truth, mask) == pytest.approx(psnr(prediction[5:20, 10:40], truth[5:20, 10:40]), abs=1e-9)
    spoilt = torch.where(mask[..., None] > 0, prediction, 1 - prediction)
    assert psnr(spoilt, truth, mask) == psnr(prediction, truth, mask)
    half = mask * 0.5
    assert psnr(prediction, truth, half) == pytest.approx(psnr(prediction, truth, mask), abs=1e-9)
    assert ssim(prediction, truth, half) == pytest.approx(ssim(prediction, truth, mask), abs=1e-9)
    assert ssim(prediction, truth, mask) != pytest.approx(ssim(prediction, truth), abs=1e-4)
    assert math.isnan(psnr(prediction, truth, mask * 0)) and math.isnan(ssim(prediction, truth, mask * 0))


def test_ssim_equals_a_float64_version_by_scipy():
    prediction, truth = noisy_pair()
    x, y = prediction.double().numpy(), truth.double().numpy()

    def blur(image):
        return scipy.ndimage.gaussian_filter(image, (1.5, 1.5, 0), mode="constant", radius=(5, 5, 0))

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    values = (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    assert ssim(prediction, truth) == pytest.approx(values.mean(), abs=1e-6)
    assert ssim(prediction * 256, truth * 256, peak=256.0) == pytest.approx(values.mean(), abs=1e-6)
    assert ssim(truth, truth) == pytest.approx(1.0, abs=1e-7)


def test_pu21_has_its_published_anchors():
    """0 at the bottom of the range and 256 at 100 cd/m^2 by construction; 595.4 at 10000 cd/m^2."""
    values = pu21_encode(torch.tensor([0.005, 100.0, 10000.0, 1e-9, 1e9], dtype=torch.float64)).tolist()
    assert values == pytest.approx([0.0, 256.0, 595.39, 0.0, 595.39], abs=0.5)
    rising = pu21_encode(torch.logspace(-2.3, 4, 200, dtype=torch.float64))
    assert (rising.diff() > 0).all()


def test_pu21_encoding_inverts_by_its_own_decoding():
    p = [0.353487901, 0.3734658629, 8.277049286e-05, 0.9062562627, 0.09150303166, 0.9099517204, 596.3148142]
    luminance = np.logspace(-2, 4, 50)
    power = np.maximum(pu21_encode(torch.tensor(luminance)).numpy() / p[6] + p[5], 0) ** (1 / p[4])
    decoded = (np.maximum(power - p[0], 0) / (p[1] - p[2] * power)) ** (1 / p[3])
    np.testing.assert_allclose(decoded, luminance, rtol=1e-6)


def test_pu21_maps_the_truths_maximum_to_the_peak():
    truth = torch.full((20, 20, 3), 0.5)
    truth[0, 0, 1] = 2.0
    prediction = truth * 1.1
    figures = pu21_metrics(prediction, truth, peak_luminance=400.0)
    levels = pu21_encode(torch.tensor([100.0, 110.0, 400.0, 440.0], dtype=torch.float64)).tolist()
    error = (1199 * (levels[1] - levels[0]) ** 2 + (levels[3] - levels[2]) ** 2) / 1200
    assert figures["psnr"] == pytest.approx(10 * math.log10(256**2 / error), abs=1e-4)
    assert 0.9 < figures["ssim"] < 1
    # The unit of radiance does not matter, the peak does; a percentile leaves the one bright pixel out.
    assert pu21_metrics(prediction * 7, truth * 7, peak_luminance=400.0) == pytest.approx(figures, abs=1e-4)
    assert pu21_metrics(prediction, truth, peak_luminance=4000.0)["psnr"] != pytest.approx(figures["psnr"], abs=0.1)
    lower = pu21_metrics(prediction, truth, peak_luminance=400.0, white_percentile=99.0)
    assert lower["psnr"] != pytest.approx(figures["psnr"], abs=0.1)
    assert pu21_metrics(truth, truth)["psnr"] == math.inf
    assert all(math.isnan(value) for value in pu21_metrics(truth, truth, torch.zeros(20, 20)).values())
    assert math.isfinite(pu21_metrics(truth, truth * 0)["psnr"])


def test_percentile_is_the_nearest_rank():
    values = torch.arange(1.0, 101.0)[torch.randperm(100)]
    assert [percentile(values, p).item() for p in (0, 1, 50, 99.5, 100)] == [1, 1, 50, 100, 100]


def test_regions_part_the_photo():
    codes = torch.tensor([[0, 0, 0], [16, 16, 16], [17, 3, 3], [249, 249, 249], [250, 0, 0], [255, 255, 255]])
    masks = region_masks((codes / 255)[None])
    assert masks["dark"].tolist() == [[True, True, False, False, False, False]]
    assert masks["clipped"].tolist() == [[False, False, False, False, True, True]]
    assert (masks["dark"].int() + masks["clipped"].int() + masks["well-exposed"].int() == 1).all()
