"""Choosing a response from photos that were made with a known one."""

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.response import Response, response_by_name
from sehdr_warp.response import selection as response_selection
from sehdr_warp.response.family import family_logs
from sehdr_warp.response.selection import edge_facts, select_response
from sehdr_warp.response.table import TabulatedResponse


def mosaic(seed=0, size=96, tile=12) -> np.ndarray:
    """Coloured tiles, anti-aliased in linear light: each boundary pixel is a mixture. [size, size, 3] in (0, 1)."""
    rng = np.random.default_rng(seed)
    colours = rng.uniform(0.02, 0.9, (size // tile, size // tile, 3))
    fine = colours.repeat(tile * 4, 0).repeat(tile * 4, 1)
    fine = np.roll(fine, (2, 1), (0, 1))
    return fine.reshape(size, 4, size, 4, 3).mean((1, 3))


def test_papers_score_orders_by_range_and_smoothness():
    photo = np.round(response_by_name("srgb").encode(mosaic()) * 255) / 255
    selection = select_response(photo, method="paper")
    scores = selection.scores
    assert [score.paper_score for score in scores] == sorted((s.paper_score for s in scores), reverse=True)
    middle_range, middle_bend = (np.median([getattr(s, f) for s in scores]) for f in ("dynamic_range", "roughness"))
    for score in scores:
        assert score.paper_score == pytest.approx(score.dynamic_range / middle_range - score.roughness / middle_bend)
    linear = next(s for s in scores if s.response.name == "linear")
    clear = photo[((photo > 1.5 / 255) & (photo < 1 - 4.5 / 255)).all(2)]
    assert linear.dynamic_range == pytest.approx(
        np.log2(np.percentile(clear, 99.9) / np.percentile(clear, 0.1)), rel=1e-3
    )


def test_thousands_of_edges_are_all_looked_at_and_count_as_few_facts():
    photos = [np.round(response_by_name("srgb").encode(mosaic(seed)) * 255) / 255 for seed in range(8)]
    few = [response_by_name(name) for name in ("srgb", "filmic")]
    selection, again = (select_response(photos, few, seed=seed) for seed in (0, 1))
    assert 3000 < selection.edge_count < 12_000
    assert [score.posterior for score in selection.scores] == [score.posterior for score in again.scores]
    assert edge_facts(1600) == 10 and edge_facts(selection.edge_count) == edge_facts(10**6) == 18.75
    for score in selection.scores:
        rest = score.highlights + score.span + score.density + score.prior
        assert score.posterior == pytest.approx(18.75 * score.edges + rest)


def test_tensors_arrays_and_codes_are_judged_alike():
    few = [response_by_name("linear"), response_by_name("srgb")]
    photo = np.round(response_by_name("srgb").encode(mosaic()) * 255) / 255
    by_array = select_response(photo, few)
    assert by_array.response in few and by_array.scores == select_response(torch.tensor(photo), few).scores
    for codes in (np.rint(photo * 255).astype(np.uint8), np.rint(photo * 65535).astype(np.uint16)):
        by_codes = select_response(codes, few)
        assert [score.posterior for score in by_codes.scores] == pytest.approx(
            [score.posterior for score in by_array.scores]
        )


@pytest.mark.parametrize(
    "image", [np.ones((8, 8, 3)), np.zeros((32, 32, 3)), np.full((32, 32, 3), np.nan), np.ones((32, 32))]
)
def test_useless_photos_are_refused(image):
    with pytest.raises(SehdrError, match="select_response"):
        select_response(image, method="paper")


def test_bad_arguments():
    photo = np.full((32, 32, 3), 0.5)
    with pytest.raises(SehdrError, match="'guess'"):
        select_response(photo, method="guess")
    with pytest.raises(SehdrError, match="no candidates"):
        select_response(photo, [])


@pytest.mark.parametrize("name", ["gamma-2.2", "srgb", "hdr-nerf", "filmic"])
def test_posterior_finds_the_response_of_a_clean_picture(name):
    response = response_by_name(name)
    photos = [np.round(response.encode(min(response.clip_exposure, 3.0) * mosaic(s)) * 255) / 255 for s in range(4)]
    assert select_response(photos).response.name == name


def test_highlights_tell_a_curve_that_clips_from_one_that_does_not():
    """Light that falls off by e per stop and has no edges: only the pile at the brightest code can tell."""
    light = np.exp2(np.random.default_rng(0).exponential(2.0, (64, 64, 1)) - 3) * np.ones(3)
    for name, other in (("srgb", "hdr-nerf"), ("hdr-nerf", "srgb")):
        candidates = [response_by_name(each) for each in (name, other)]
        photo = np.round(candidates[0].encode(light * 4) * 255) / 255
        right, wrong = (
            next(s for s in select_response(photo, candidates).scores if s.response is each) for each in candidates
        )
        assert right.highlights < wrong.highlights - 0.5


def test_span_tells_a_curve_that_never_clips():
    """Light of 1.35 nats without edges or whites: under most others it spans a third or half of that."""
    light = np.exp(np.random.default_rng(0).normal(1.5, 1.35, (64, 64, 1))) * np.ones(3)
    truth = response_by_name("hdr-nerf")
    photo = np.round(truth.encode(light) * 255) / 255
    scores = {s.response.name: s for s in select_response(photo).scores}
    assert scores["hdr-nerf"].span < 0.2
    assert all(score.span > 1 for name, score in scores.items() if name in ("srgb", "rec709", "camera", "filmic"))
    # Nothing between black and white: no curve is told from another.
    nothing = select_response(np.ones((32, 32, 3)), from_camera=True).scores
    assert {score.span for score in nothing} == {0.0}


def test_density_tells_curves_that_heap_light_up():
    """Log-normal light without edges: under the true curve its density is smooth, the other bends the bright end."""
    light = np.exp(np.random.default_rng(0).normal(-1.2, 1.0, (96, 96, 3)))
    for name, other in (("camera", "hdr-nerf"), ("hdr-nerf", "camera")):
        truth = response_by_name(name)
        photo = np.round(np.clip(truth.encode(light), 0, 1) * 255) / 255
        density = {s.response.name: s.density for s in select_response(photo).scores}
        assert density[name] < density[other] - 0.8
    blank = select_response(np.ones((32, 32, 3)), from_camera=True).scores
    assert {score.density for score in blank} == {0.0}


def test_edges_that_no_curve_explains_say_little(monkeypatch):
    """Noise on the mixed pixels alone: how large it is must be found, not taken for what rounding does."""
    truth, rng = response_by_name("srgb"), np.random.default_rng(0)
    photos = [truth.encode(mosaic(seed)) for seed in range(4)]
    spoilt = [photo + rng.normal(0, 6 / 255, photo.shape) * rough(photo) for photo in photos]
    spoilt = [np.round(photo.clip(0, 1) * 255) / 255 for photo in spoilt]
    few = [response_by_name(name) for name in ("srgb", "hdr-nerf", "camera")]

    def costs():
        return np.array([score.edges for score in select_response(spoilt, few).scores])

    found = costs()
    monkeypatch.setattr(response_selection, "EDGE_MISFITS", np.array([1.0]))
    as_rounding = costs()
    assert np.ptp(found) < 0.9 * np.ptp(as_rounding) and (found < as_rounding - 0.2).all()


def rough(photo):
    """1 at the mixed pixels of a mosaic, 0 within its tiles. [H, W, 1]."""
    step = sum(np.abs(photo - np.roll(photo, shift, axis)).max(2) for shift in (1, -1) for axis in (0, 1))
    return (step > 2 / 255)[..., None] * 1.0


def test_prior_of_cameras_decides_where_nothing_else_does():
    ramp = np.linspace(0.1, 0.9, 64)[None, :, None] * np.ones((64, 1, 3))
    selection = select_response(ramp, from_camera=True)
    assert selection.response.name == "camera" and selection.method == "posterior" and selection.edge_count == 0
    scores = {score.response.name: score.prior for score in selection.scores}
    assert scores["camera"] < scores["rec709"] < scores["linear"]


def test_large_photos_are_read_in_bands():
    response = response_by_name("gamma-2.2")
    photo = np.tile(np.round(response.encode(mosaic()) * 255) / 255, (8, 8, 1))
    selection = select_response(photo)
    assert photo.shape[0] * photo.shape[1] > 400_000 and selection.response.name == "gamma-2.2"


def test_posterior_needs_no_well_exposed_pixel():
    for photo in (np.zeros((32, 32, 3)), np.ones((32, 32, 3))):
        chosen = select_response(photo, from_camera=True)
        assert chosen.response.name in ("camera", "rec709") and np.isnan(chosen.scores[0].edges)


def test_posterior_never_takes_photos_for_linear():
    photos = [np.round(mosaic(seed) * 255) / 255 for seed in range(4)]
    selection = select_response(photos)
    assert min(selection.scores, key=lambda score: score.edges).response.name == "linear"
    assert selection.response.name != "linear"


def family_curve(draw: int):
    """A member of the family that posterior photos are judged by, as a response."""
    logs, _ = family_logs()
    return TabulatedResponse(f"member {draw}", np.concatenate([[0.0], np.exp(logs[draw, 1:])]), np.arange(256) / 255)


def stops_off(response, truth) -> float:
    codes = np.arange(10, 246) / 255
    return float(np.std(np.log2(response.decode(codes)) - np.log2(truth.decode(codes))))


def test_family_is_increasing_and_holds_what_cameras_do():
    logs, rises = family_logs()
    assert logs.shape == rises.shape == (512, 256) and (np.diff(logs[:, 1:]) > 0).all()
    assert rises[:, 128] == pytest.approx((logs[:, 129] - logs[:, 127]) * 127.5, rel=1e-3)
    # Nearer than this to one of 512 curves: the camera's, sRGB, and light that is stored as it is.
    for name, most in (("camera", 0.12), ("srgb", 0.15), ("linear", 0.2)):
        stops = np.log2(response_by_name(name).decode(np.arange(10, 246) / 255))
        assert (logs[:, 10:246] / np.log(2) - stops).std(1).min() < most


def test_curve_that_is_no_formula_is_met_by_the_posteriors_mean():
    off_mean, off_formula = [], []
    for draw in (3, 40, 77):
        truth = family_curve(draw)
        photos = [np.round(truth.encode(truth.clip_exposure * mosaic(seed)) * 255) / 255 for seed in range(4)]
        selection = select_response(photos)
        assert selection.response.name == "posterior mean"
        off_mean.append(stops_off(selection.response, truth))
        off_formula.append(stops_off(selection.scores[0].response, truth))
    assert np.mean(off_mean) < 0.15 and np.mean(off_mean) < 0.5 * np.mean(off_formula)


def test_candidates_that_are_given_and_photos_of_cameras_get_no_family():
    truth = family_curve(3)
    photo = np.round(truth.encode(truth.clip_exposure * mosaic()) * 255) / 255
    given = [response_by_name(name) for name in ("srgb", "camera")]
    for selection in (
        select_response(photo, given),
        select_response(photo, from_camera=True),
        select_response(photo, method="paper"),
    ):
        assert selection.response is selection.scores[0].response


def test_posteriors_mean_can_be_stored():
    selection = select_response(np.full((32, 32, 3), 0.5))
    again = Response.from_dict(selection.response.to_dict())
    assert selection.edge_count == 0 and selection.response.name == "posterior mean"
    values = np.linspace(0, 1, 50)
    assert np.allclose(again.decode(values), selection.response.decode(values))
