"""Choosing a response from photos that were made with a known one."""

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.response import Response, response_by_name
from sehdr_warp.response.selection import select_response
from sehdr_warp.response.selection_scores import FINE, edge_facts, family_curves
from sehdr_warp.response.table import TabulatedResponse

from .mosaics import CODES, mosaic, photograph, responses, stops_off


def test_thousands_of_edges_are_all_looked_at_and_count_as_few_facts_and_more_are_drawn_from():
    photos, few = [photograph("srgb", mosaic(seed)) for seed in range(4)], responses("srgb", "filmic")
    selection, again = (select_response(photos[:3], few, seed=seed) for seed in (0, 1))
    assert 3000 < selection.edge_count < select_response(photos, few).edge_count == 4000
    assert [score.posterior for score in selection.scores] == [score.posterior for score in again.scores]
    assert edge_facts(800) == 10 and edge_facts(selection.edge_count) == edge_facts(10**6) == 18.75
    for score in selection.scores:
        rest = score.highlights + score.span + score.density + score.prior
        assert score.posterior == pytest.approx(18.75 * score.edges + rest)


@pytest.mark.parametrize(
    "image, options, words",
    [
        (np.ones((8, 8, 3)), {"method": "paper"}, "under 100 pixels"),
        (np.zeros((32, 32, 3)), {"method": "paper"}, "under 100 pixels"),
        (np.full((32, 32, 3), np.nan), {}, "not finite"),
        (np.ones((32, 32)), {}, r"\[32, 32\]"),
        (np.full((32, 32, 3), 0.5), {"method": "guess"}, "'guess'"),
        (np.full((32, 32, 3), 0.5), {"candidates": []}, "no candidates"),
    ],
)
def test_what_cannot_be_judged_is_refused(image, options, words):
    with pytest.raises(SehdrError, match=f"select_response: .*{words}"):
        select_response(image, **options)


@pytest.mark.parametrize("name", ["gamma-2.2", "srgb", "hdr-nerf", "filmic"])
def test_posterior_finds_the_response_of_a_clean_picture(name):
    exposure = min(response_by_name(name).clip_exposure, 3.0)
    photos = [photograph(name, exposure * mosaic(seed)) for seed in range(4)]
    assert select_response(photos).response.name == name


def test_uncertainty_is_small_with_edges_and_large_without():
    clean = select_response([photograph("srgb", mosaic(seed)) for seed in range(4)])
    grey = select_response(np.linspace(0.1, 0.9, 64)[None, :, None] * np.ones((64, 1, 3)))
    assert clean.uncertainty < 0.2 < 0.4 < grey.uncertainty < 3
    alone = select_response(photograph("srgb", mosaic()), candidates=responses("srgb"))
    assert alone.uncertainty == pytest.approx(0, abs=1e-6)
    assert np.isnan(select_response(photograph("srgb", mosaic()), method="paper").uncertainty)


def family_curve(draw: int) -> Response:
    """A member of the family that posterior photos are judged by."""
    logs = family_curves()[0][:, ::FINE]
    return TabulatedResponse(f"member {draw}", np.concatenate([[0.0], np.exp(logs[draw, 1:])]), CODES)


def test_cameras_own_jpegs_state_by_how_much_cameras_differ():
    """Their curve is taken by prior: their edges, which are sharpened, must not make it look sure."""
    for truth in (response_by_name("camera"), *map(family_curve, (3, 40, 77))):
        photos = [photograph(truth, truth.clip_exposure * mosaic(seed)) for seed in range(4)]
        selection = select_response(photos, from_camera=True)
        assert selection.response.name in ("camera", "rec709")
        assert stops_off(selection.response, truth) < 2 * selection.uncertainty < 1.2
        assert "use RAW photos" in selection.note


def test_curve_that_is_no_formula_is_met_by_the_posteriors_mean():
    off_mean, off_formula = [], []
    for draw in (3, 40, 77):
        truth = family_curve(draw)
        selection = select_response([photograph(truth, truth.clip_exposure * mosaic(seed)) for seed in range(4)])
        assert selection.response.name == "posterior mean"
        off_mean.append(stops_off(selection.response, truth))
        off_formula.append(stops_off(selection.scores[0].response, truth))
        assert off_mean[-1] < 2 * selection.uncertainty
    assert np.mean(off_mean) < 0.15 and np.mean(off_mean) < 0.5 * np.mean(off_formula)
    again = Response.from_dict(selection.response.to_dict())
    np.testing.assert_allclose(again.decode(CODES), selection.response.decode(CODES))
