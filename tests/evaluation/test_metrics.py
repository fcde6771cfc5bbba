"""Metrics against analytic values, published values and independent implementations."""

import math

import pytest
import scipy.ndimage
import torch

from sehdr_warp.evaluation.metrics import mu_law, psnr, pu21_encode, pu21_metrics, region_masks, ssim


def noisy_pair(shape=(48, 61, 3), noise=0.1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(shape, generator=generator)
    return (truth + noise * torch.randn(shape, generator=generator)).clamp(0, 1), truth


def test_mu_law_is_the_papers_equation():
    values = torch.tensor([0.0, 1e-4, 0.01, 0.5, 1.0, -3.0, 7.0], dtype=torch.float64)
    expected = [math.log(value) / math.log(5001) for value in (1, 1.5, 51, 2501, 5001, 1, 5001)]
    assert mu_law(values).tolist() == pytest.approx(expected, abs=1e-15)
    assert mu_law(torch.tensor(0.1, dtype=torch.float64), mu=10).item() == pytest.approx(math.log(2) / math.log(11))


def test_psnr_of_a_known_offset():
    truth = torch.full((7, 9, 3), 0.25)
    assert psnr(truth + 0.125, truth) == pytest.approx(20 * math.log10(8), abs=1e-6)
    assert psnr((truth + 0.125) * 255, truth * 255, peak=255.0) == pytest.approx(20 * math.log10(8), abs=1e-6)
    assert psnr(truth, truth) == math.inf


def test_masks_weigh_the_pixels():
    prediction, truth = noisy_pair()
    mask = torch.zeros(48, 61)
    mask[5:20, 10:40] = 1
    assert psnr(prediction, truth, mask) == pytest.approx(psnr(prediction[5:20, 10:40], truth[5:20, 10:40]), abs=1e-9)
    for poison in (math.nan, math.inf, 3e38):
        spoilt = torch.where(mask[..., None] > 0, prediction, poison)
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


def test_pu21_maps_the_truths_maximum_to_the_peak():
    truth = torch.full((20, 20, 3), 0.5)
    truth[0, 0, 1] = 2.0
    prediction = truth * 1.1
    figures = pu21_metrics(prediction, truth, peak_luminance=400.0)
    levels = pu21_encode(torch.tensor([100.0, 110.0, 400.0, 440.0], dtype=torch.float64)).tolist()
    error = (1199 * (levels[1] - levels[0]) ** 2 + (levels[3] - levels[2]) ** 2) / 1200
    assert figures["psnr"] == pytest.approx(10 * math.log10(256**2 / error), abs=1e-4)
    assert 0.9 < figures["ssim"] < 1
    # The unit of radiance does not matter, the peak does.
    assert pu21_metrics(prediction * 7, truth * 7, peak_luminance=400.0) == pytest.approx(figures, abs=1e-4)
    assert pu21_metrics(prediction, truth, peak_luminance=4000.0)["psnr"] != pytest.approx(figures["psnr"], abs=0.1)
    assert pu21_metrics(truth, truth)["psnr"] == math.inf
    assert all(math.isnan(value) for value in pu21_metrics(truth, truth, torch.zeros(20, 20)).values())
    assert math.isfinite(pu21_metrics(truth, truth * 0)["psnr"])


def test_regions_part_the_photo():
    codes = torch.tensor([[0, 0, 0], [16, 16, 16], [17, 3, 3], [249, 249, 249], [250, 0, 0], [255, 255, 255]])
    masks = region_masks((codes / 255)[None])
    assert masks["dark"].tolist() == [[True, True, False, False, False, False]]
    assert masks["clipped"].tolist() == [[False, False, False, False, True, True]]
    assert (masks["dark"].int() + masks["clipped"].int() + masks["well-exposed"].int() == 1).all()
