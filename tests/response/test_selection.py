"""Choosing a response from photos that were made with a known one."""

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.response import Response, response_by_name, selection_scores
from sehdr_warp.response.selection import select_response
from sehdr_warp.response.selection_scores import FINE, edge_facts, family_curves
from sehdr_warp.response.table import TabulatedResponse
from sehdr_warp.scene.response_choice import select_for_codes

CODES = np.arange(256) / 255


def mosaic(seed=0, size=96, tile=12) -> np.ndarray:
    """Colored tiles, anti-aliased in linear light: each boundary pixel is a mixture. [size, size, 3] in (0, 1)."""
    rng = np.random.default_rng(seed)
    colors = rng.uniform(0.02, 0.9, (size // tile, size // tile, 3))
    fine = np.roll(colors.repeat(tile * 4, 0).repeat(tile * 4, 1), (2, 1), (0, 1))
    return fine.reshape(size, 4, size, 4, 3).mean((1, 3))


def photograph(response, light) -> np.ndarray:
    """Encoded values as 8 bits store them."""
    response = response_by_name(response) if isinstance(response, str) else response
    return np.round(np.clip(response.encode(light), 0, 1) * 255) / 255


def by_name(selection) -> dict:
    return {score.response.name: score for score in selection.scores}


def named(*names) -> list[Response]:
    return [response_by_name(name) for name in names]


def shaded(light, seed) -> np.ndarray:
    """Light whose mixed pixels are darker by up to a half, as in contact shadows and at the rims of curved surfaces."""
    mixed = np.zeros(light.shape[:2], bool)
    for axis in (0, 1):
        before, after = np.roll(light, 1, axis), np.roll(light, -1, axis)
        mixed |= ((light != before) & (light != after)).any(2)
    return light * np.where(mixed, np.random.default_rng(seed).uniform(0.5, 1.0, mixed.shape), 1.0)[..., None]


def test_papers_score_orders_by_range_and_smoothness():
    photo = photograph("srgb", mosaic())
    scores = select_response(photo, method="paper").scores
    assert [score.paper_score for score in scores] == sorted((s.paper_score for s in scores), reverse=True)
    middle_range, middle_bend = (np.median([getattr(s, f) for s in scores]) for f in ("dynamic_range", "roughness"))
    for score in scores:
        assert score.paper_score == pytest.approx(score.dynamic_range / middle_range - score.roughness / middle_bend)
    linear = next(s for s in scores if s.response.name == "linear")
    clear = photo[((photo > 1.5 / 255) & (photo < 1 - 4.5 / 255)).all(2)]
    low, high = np.percentile(clear, (0.1, 99.9))
    assert linear.dynamic_range == pytest.approx(np.log2(high / low), rel=1e-3)


def test_thousands_of_edges_are_all_looked_at_and_count_as_few_facts_and_more_are_drawn_from():
    photos, few = [photograph("srgb", mosaic(seed)) for seed in range(4)], named("srgb", "filmic")
    selection, again = (select_response(photos[:3], few, seed=seed) for seed in (0, 1))
    assert 3000 < selection.edge_count < select_response(photos, few).edge_count == 4000
    assert [score.posterior for score in selection.scores] == [score.posterior for score in again.scores]
    assert edge_facts(800) == 10 and edge_facts(selection.edge_count) == edge_facts(10**6) == 18.75
    for score in selection.scores:
        rest = score.highlights + score.span + score.density + score.prior
        assert score.posterior == pytest.approx(18.75 * score.edges + rest)


def test_arrays_and_codes_are_judged_alike():
    few, photo = named("linear", "srgb"), photograph("srgb", mosaic())
    by_array = select_response(photo, few)
    assert by_array.response in few
    expected = [score.posterior for score in by_array.scores]
    for codes in (np.rint(photo * 255).astype(np.uint8), np.rint(photo * 65535).astype(np.uint16)):
        assert [score.posterior for score in select_response(codes, few).scores] == pytest.approx(expected)


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


@pytest.mark.parametrize("name", ["srgb", "hdr-nerf", "camera"])
def test_shading_at_edges_does_not_mislead(name, monkeypatch):
    """The line of an edge's sides misses its middle color under every curve then; their plane with black does not."""
    exposure = min(response_by_name(name).clip_exposure, 3.0)
    photos = [photograph(name, shaded(exposure * mosaic(seed), seed)) for seed in range(4)]
    excess = []
    for weight in (selection_scores.LINE_WEIGHT, 1e3):
        monkeypatch.setattr(selection_scores, "LINE_WEIGHT", weight)
        edges = {key: score.edges / max(weight, 1) for key, score in by_name(select_response(photos)).items()}
        excess.append(edges[name] - min(edges.values()))
    assert excess[0] < 0.01 < excess[1]


@pytest.mark.parametrize("name", ["gamma-2.2", "srgb", "hdr-nerf", "filmic"])
def test_posterior_finds_the_response_of_a_clean_picture(name):
    exposure = min(response_by_name(name).clip_exposure, 3.0)
    photos = [photograph(name, exposure * mosaic(seed)) for seed in range(4)]
    assert select_response(photos).response.name == name


def falling_light() -> np.ndarray:
    """Light that falls off by e per stop and has no edges: only the pile at the brightest code can tell."""
    return np.exp2(np.random.default_rng(0).exponential(2.0, (64, 64, 1)) - 1) * np.ones(3)


def normal_light() -> np.ndarray:
    """Log-normal light without edges: under the true curve its density is smooth."""
    return np.exp(np.random.default_rng(0).normal(-1.2, 1.0, (96, 96, 3)))


@pytest.mark.parametrize(
    "light, pair, part, apart",
    [(falling_light, ("srgb", "hdr-nerf"), "highlights", 0.5), (normal_light, ("camera", "hdr-nerf"), "density", 0.8)],
)
def test_light_without_edges_tells_curves_apart(light, pair, part, apart):
    for right, wrong in (pair, pair[::-1]):
        scores = by_name(select_response(photograph(right, light()), named(*pair)))
        assert getattr(scores[right], part) < getattr(scores[wrong], part) - apart


def test_span_tells_a_curve_that_never_clips():
    """Light of 1.35 nats without edges or whites: under most others it spans a third or half of that."""
    light = np.exp(np.random.default_rng(0).normal(1.5, 1.35, (64, 64, 1))) * np.ones(3)
    scores = by_name(select_response(photograph("hdr-nerf", light)))
    assert scores["hdr-nerf"].span < 0.2
    assert all(scores[name].span > 1 for name in ("srgb", "rec709", "camera", "filmic"))


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_photos_without_a_well_exposed_pixel_are_judged_by_the_prior(value):
    chosen = select_response(np.full((32, 32, 3), value), from_camera=True)
    assert chosen.response.name in ("camera", "rec709") and np.isnan(chosen.scores[0].edges)
    assert {(score.span, score.density) for score in chosen.scores} == {(0.0, 0.0)}


def test_prior_of_cameras_decides_where_nothing_else_does():
    ramp = np.linspace(0.1, 0.9, 64)[None, :, None] * np.ones((64, 1, 3))
    selection = select_response(ramp, from_camera=True)
    assert selection.response.name == "camera" and selection.method == "posterior" and selection.edge_count == 0
    scores = by_name(selection)
    assert scores["camera"].prior < scores["rec709"].prior < scores["linear"].prior


def test_large_photos_are_read_in_bands():
    photo = np.tile(photograph("gamma-2.2", mosaic()), (8, 8, 1))
    assert photo.shape[0] * photo.shape[1] > 400_000 and select_response(photo).response.name == "gamma-2.2"


def test_posterior_never_takes_photos_for_linear():
    selection = select_response([photograph("linear", mosaic(seed)) for seed in range(4)])
    assert min(selection.scores, key=lambda score: score.edges).response.name == "linear"
    assert selection.response.name != "linear"


def test_uncertainty_is_small_with_edges_and_large_without():
    clean = select_response([photograph("srgb", mosaic(seed)) for seed in range(4)])
    grey = select_response(np.linspace(0.1, 0.9, 64)[None, :, None] * np.ones((64, 1, 3)))
    assert clean.uncertainty < 0.2 < 0.4 < grey.uncertainty < 3
    alone = select_response(photograph("srgb", mosaic()), candidates=named("srgb"))
    assert alone.uncertainty == pytest.approx(0, abs=1e-6)
    assert np.isnan(select_response(photograph("srgb", mosaic()), method="paper").uncertainty)


def test_a_guess_is_told():
    ramp = np.rint(255 * np.linspace(0.1, 0.9, 64)[None, :, None] * np.ones((64, 1, 3))).astype(np.uint8)
    note = select_for_codes([ramp], [None], "posterior", ()).note
    assert "is a guess: curves that explain the photos as well differ from it by" in note
    codes = [np.rint(255 * photograph("srgb", mosaic(seed))).astype(np.uint8) for seed in range(4)]
    assert select_for_codes(codes, [None] * 4, "posterior", ()).note is None
    assert select_for_codes(codes, [None] * 4, "paper", ()).note is None


def family_curve(draw: int) -> Response:
    """A member of the family that posterior photos are judged by."""
    logs = family_curves()[0][:, ::FINE]
    return TabulatedResponse(f"member {draw}", np.concatenate([[0.0], np.exp(logs[draw, 1:])]), CODES)


def stops_off(response, truth) -> float:
    return float(np.std(np.log2(response.decode(CODES[10:246])) - np.log2(truth.decode(CODES[10:246]))))


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
