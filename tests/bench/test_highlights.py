"""Estimates of clipped light, where the answer is known: log exposures drawn from a normal distribution."""

from types import SimpleNamespace

import numpy as np
import pytest

from sehdr_warp.bench.highlights import Case, fitted_by_count, of_share, tobit
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import View
from tests.training.toy import orbit_camera

SPREAD = 1.5


@pytest.fixture(scope="module")
def case():
    """Two photos of 128 x 128, 25 % of whose values clip; channels are drawn apart."""
    response, rng = response_by_name("srgb"), np.random.default_rng(0)
    views = []
    for index, split in enumerate(("train", "test")):
        exposure = response.white * 2.0 ** rng.normal(-1.0, SPREAD, (128, 128, 3))
        photo = np.round(response.encode(exposure) * 255) / 255
        camera = orbit_camera(0.0, 128)
        views.append(View(f"v_{index}", photo.astype(np.float32), camera, 0.5, split, hdr=exposure / 0.5))
    return Case(SimpleNamespace(views=views, train_views=views[:1]), response)


def test_a_normal_distribution_is_found_again(case):
    mean, median = tobit(case)
    assert case.share == pytest.approx(0.25, abs=0.02)
    assert mean == pytest.approx(case.excess[0].mean(), abs=0.03)
    assert median == pytest.approx(np.median(case.excess[0]), abs=0.03)
    assert of_share(case, SPREAD) == pytest.approx(mean, abs=0.05)


def test_what_does_not_depend_on_the_count_is_fitted_as_one_mean(case):
    stops = fitted_by_count([case], lambda _: 1.0)
    np.testing.assert_allclose(stops, case.excess[0].mean(), atol=0.05)
    assert case.psnr(0.0) < case.psnr(stops.mean()) < case.psnr(case.excess[1])
    assert case.psnr(case.excess[1]) == pytest.approx(38.0, abs=0.01)
