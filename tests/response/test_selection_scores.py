"""Score of a candidate response, part by part."""

import numpy as np
import pytest

from sehdr_warp.response import response_by_name
from sehdr_warp.response.selection import select_response

from .mosaics import by_name, mosaic, photograph, responses


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


@pytest.mark.parametrize("name", ["srgb", "hdr-nerf", "camera"])
def test_shading_at_edges_does_not_mislead(name):
    """The line of an edge's sides misses its middle color under every curve then; their plane with black does not."""
    exposure = min(response_by_name(name).clip_exposure, 3.0)
    photos = [photograph(name, shaded(exposure * mosaic(seed), seed)) for seed in range(4)]
    edges = {key: score.edges for key, score in by_name(select_response(photos)).items()}
    assert edges[name] < min(edges.values()) + 0.01


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
        scores = by_name(select_response(photograph(right, light()), responses(*pair)))
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


def test_posterior_never_takes_photos_for_linear():
    selection = select_response([photograph("linear", mosaic(seed)) for seed in range(4)])
    assert min(selection.scores, key=lambda score: score.edges).response.name == "linear"
    assert selection.response.name != "linear"
