"""Evaluation of a run whose renders are known, so that every figure can be predicted."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.evaluation.compare import eval_table
from sehdr_warp.evaluation.evaluate import evaluate
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera, Scene, View, codes_of, encoded_values

RESPONSE = response_by_name("hdr-nerf")


def radiance(index, height=24, width=30):
    rng = np.random.default_rng(index)
    return (10 ** rng.uniform(-2.5, 1.5, (height, width, 3))).astype(np.float32)


def view(index, split, *, truth=True, mask=None, exposure_time=2.0, photo=None):
    hdr = radiance(index)
    pose = np.eye(4)
    pose[0, 3] = index  # the camera tells the fake run which view it is
    camera = Camera(30, 24, 25.0, 25.0, 15.0, 12.0, pose)
    image = RESPONSE.encode(hdr * exposure_time) if photo is None else photo
    return View(f"r_{index}", codes_of(image, 16), camera, exposure_time, split, mask, hdr if truth else None)


def scene(views):
    return Scene("box", "transforms", tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def run(change=lambda hdr: hdr):
    """A run that renders change(true radiance)."""

    def render(camera):
        hdr = torch.tensor(radiance(int(camera.world_to_camera[0, 3])))
        return SimpleNamespace(hdr=change(hdr))

    def render_ldr(camera, seconds):
        photo = RESPONSE.encode(render(camera).hdr * seconds).numpy()
        return torch.tensor(encoded_values(codes_of(photo, 16)))

    numbers = {"train_seconds": 12.5, "gaussian_count": 4321, "iterations": 700}
    sure = {"response": RESPONSE, "render_confidence": lambda camera: None, "normalize_photos": lambda scene: scene}
    return SimpleNamespace(render=render, render_ldr=render_ldr, device="cpu", cameras=(), **sure, **numbers)


@pytest.fixture(autouse=True)
def no_weights(monkeypatch):
    monkeypatch.delenv("SEHDR_LPIPS", raising=False)


VIEWS = [view(0, "train"), view(1, "train"), view(2, "test"), view(3, "test")]


def test_what_training_photos_show_clipped_does_not_decide_the_scale():
    photo = np.ones((24, 30, 3), np.float32)
    photo[20:] = 0.5

    def change(hdr):
        changed = hdr / 2.1
        changed[:20] /= 3
        return changed

    views = [view(0, "train", photo=photo), *VIEWS[2:]]
    assert evaluate(run(change), scene(views))["protocol"]["aligned"]["scale"] == pytest.approx(2.1)
    plain = [view(0, "train", photo=np.full_like(photo, 0.5)), *VIEWS[2:]]
    assert evaluate(run(change), scene(plain))["protocol"]["aligned"]["scale"] == pytest.approx(6.3)


def test_a_perfect_render_is_strict_json():
    result = evaluate(run(), scene(VIEWS))
    assert result["protocol"]["gt-max"]["psnr_mu"] is None and "infinite" in result["protocol"]["gt-max"]["reason"]
    assert result["regions"]["clipped"]["psnr_ldr"] is None and "infinite" in result["regions"]["clipped"]["reason"]
    assert result["protocol"]["gt-max"]["ssim_mu"] == pytest.approx(1.0)
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    trained_on = evaluate(run(lambda hdr: hdr * 1.1), scene(VIEWS[:2]))
    assert trained_on["split"] == "train" and len(trained_on["views"]) == 2
    assert "no test views" in eval_table(trained_on)
    lights, remedy = {"count": 3, "lost": 1, "energies": [0.2, 0.9]}, "darker photos would measure it"
    assert remedy in eval_table(result | {"lights": lights})
    assert remedy not in eval_table(result | {"lights": lights | {"lost": 0}})


def test_a_scene_without_truth_keeps_its_ldr_figures():
    result = evaluate(run(lambda hdr: hdr * 1.1), scene([view(0, "train", truth=False), view(1, "test", truth=False)]))
    assert result["ldr"]["psnr"] > 20 and result["ldr"]["ssim"] > 0.9
    for name in ("gt-max", "self-max", "aligned"):
        assert result["protocol"][name]["psnr_mu"] is None and "no HDR truth" in result["protocol"][name]["reason"]
        assert result["pu21"][name]["psnr"] is None
    region = result["regions"]["well-exposed"]
    assert region["psnr_ldr"] > 20 and region["psnr_mu"]["gt-max"] is None and "no HDR truth" in region["reason"]
    json.dumps(result, allow_nan=False)
    assert "no HDR truth" in eval_table(result)


def test_truth_of_the_test_views_alone_leaves_out_the_aligned_figures():
    result = evaluate(run(lambda hdr: hdr * 1.1), scene([view(0, "train", truth=False), view(1, "test")]))
    assert result["protocol"]["gt-max"]["psnr_mu"] > 20
    assert result["protocol"]["aligned"]["psnr_mu"] is None
    assert "training view" in result["protocol"]["aligned"]["reason"]


def test_regions_pool_their_errors():
    photo = np.full((24, 30, 3), 0.5, np.float32)
    photo[:6], photo[6:12] = 1.0, 0.02
    views = [view(0, "train"), view(1, "test", photo=photo)]

    def clipped_wrong(hdr):
        hdr = hdr.clone()
        hdr[:6] *= 3
        return hdr

    result = evaluate(run(clipped_wrong), scene(views))
    regions = result["regions"]
    assert [regions[r]["fraction"] for r in ("clipped", "well-exposed", "dark")] == pytest.approx([0.25, 0.5, 0.25])
    assert regions["clipped"]["psnr_mu"]["gt-max"] < 25
    assert regions["dark"]["psnr_mu"]["gt-max"] is None and "infinite" in regions["dark"]["reason"]
    encoded = RESPONSE.encode(radiance(1)[6:12] * 2)
    assert regions["dark"]["psnr_ldr"] == pytest.approx(-10 * np.log10(np.mean((encoded - 0.02) ** 2)), abs=1e-3)


def test_a_region_without_pixels_says_so_and_each_views_own_exposure_is_used():
    flat = np.full((24, 30, 3), 0.5, np.float32)
    result = evaluate(run(), scene([view(0, "train"), view(1, "test", photo=flat)]))
    timed = [view(0, "train"), view(1, "test", exposure_time=0.1), view(2, "test", exposure_time=8.0)]
    assert evaluate(run(), scene(timed))["ldr"]["ssim"] == pytest.approx(1.0)
    assert result["regions"]["clipped"]["psnr_ldr"] is None and "no pixel" in result["regions"]["clipped"]["reason"]
    json.dumps(result, allow_nan=False)


def test_masked_pixels_cost_nothing():
    mask = np.ones((24, 30), np.float32)
    mask[:, 20:] = 0

    def spoil(hdr):
        hdr = hdr * 1.05
        hdr[:, 20:] = 1e5
        return hdr

    views = [view(0, "train", mask=mask), view(1, "test", mask=mask)]
    spoilt, clean = evaluate(run(spoil), scene(views)), evaluate(run(lambda hdr: hdr * 1.05), scene(views))
    assert spoilt == clean
    assert sum(region["fraction"] for region in clean["regions"].values()) == pytest.approx(1.0)
    hidden = view(2, "test", mask=np.zeros((24, 30), np.float32))
    assert evaluate(run(spoil), scene([*views, hidden]))["ldr"] == clean["ldr"]
    unmasked = evaluate(run(spoil), scene([view(0, "train"), view(1, "test")]))
    assert unmasked["ldr"]["psnr"] < clean["ldr"]["psnr"] - 10


def test_what_cannot_be_evaluated_is_said():
    with pytest.raises(SehdrError, match="no views"):
        evaluate(run(), scene([]))
    with pytest.raises(SehdrError, match="its picture is 30 x 23, its photo 30 x 24; take both at one size"):
        evaluate(run(lambda hdr: hdr[:-1]), scene(VIEWS))
    with pytest.raises(SehdrError, match="not finite"):
        evaluate(run(lambda hdr: hdr * float("nan")), scene(VIEWS))


def test_pixels_of_part_of_the_weight_count_by_it():
    """Pixels of a panorama count by their solid angles."""
    weights = np.full((24, 30), 1.0, np.float32)
    weights[:12] = 0.25
    photo = np.full((24, 30, 3), 0.5, np.float32)
    views = [view(0, "train"), view(1, "test", mask=weights, photo=photo, truth=False)]
    wrong = torch.tensor(photo)
    wrong[:12] += 0.1
    evaluated = run()
    evaluated.render_ldr = lambda camera, seconds: wrong
    error = 0.25 * 0.1**2 / (0.25 + 1)
    assert evaluate(evaluated, scene(views))["ldr"]["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)


def test_confidence_is_ranked_against_errors():
    plain = evaluate(run(lambda hdr: hdr / 2.1), scene(VIEWS))["confidence"]
    assert plain["spearman_log2"] is None and "not measured" in plain["reason"]
    doubt = torch.rand(24, 30, generator=torch.Generator().manual_seed(1))
    doubtful_run = run(lambda hdr: hdr * 2 ** (3 * doubt[..., None]))
    doubtful_run.render_confidence = lambda camera: 1 - doubt
    result = evaluate(doubtful_run, scene(VIEWS))
    assert result["confidence"]["pixels"] == 2 * 24 * 30
    # The scale is the median's: errors grow with doubt on one side of it and fall on the other.
    doubtful_run.render_confidence = lambda camera: 1 - (doubt - doubt.median()).abs()
    better = evaluate(doubtful_run, scene(VIEWS))
    assert better["confidence"]["spearman_log2"] > 0.8 > result["confidence"]["spearman_log2"]
    assert "confidence ranks errors: " in eval_table(better)
    without = evaluate(doubtful_run, scene([view(0, "train", truth=False), view(1, "test", truth=False)]))
    assert without["confidence"]["spearman_log2"] is None and "no HDR truth" in without["confidence"]["reason"]
