"""Confidence: what a photo leaves in doubt, and what gathers on the Gaussians that are seen in it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.model.confidence import (
    CLIPPED_STOPS,
    HALF_CONFIDENCE_PIXELS,
    MAX_STOPS,
    PARTLY_CLIPPED_STOPS,
    Evidence,
    gather_evidence,
    pixel_uncertainty,
)
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.model.renders import CameraTensors
from sehdr_warp.rasterizer import rasterize
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.run import Splats
from sehdr_warp.scene import Camera, View, codes_of

SRGB = response_by_name("srgb")
CAMERA = Camera(20, 12, 15.0, 15.0, 10.0, 6.0, np.eye(4))


def doubt(photo, exposure):
    stops, clipped, _ = pixel_uncertainty(torch.tensor([[photo]]), torch.tensor([[exposure]]), SRGB)
    return float(stops), float(clipped)


def test_doubt_of_single_pixels():
    grey = float(SRGB.encode(torch.tensor(0.25)))
    exact, clipped = doubt([grey] * 3, [0.25] * 3)
    rounding = np.log2(np.subtract(*SRGB.decode(np.array([grey + 0.5 / 255, grey - 0.5 / 255]))) / 0.25 + 1)
    assert exact == pytest.approx(rounding / 4, rel=0.02) and clipped == 0
    assert doubt([grey] * 3, [1.0, 0.25, 0.25])[0] == pytest.approx(exact + 2 / 3, abs=1e-4)
    assert doubt([1.0] * 3, [8.0] * 3) == (pytest.approx(CLIPPED_STOPS), 1.0)
    assert doubt([1.0] * 3, [SRGB.white / 4] * 3)[0] == pytest.approx(CLIPPED_STOPS + 2, abs=1e-4)
    stops, clipped = doubt([1.0, grey, grey], [8.0, 0.25, 0.25])
    assert stops == pytest.approx((PARTLY_CLIPPED_STOPS + 2 * exact) / 3, abs=1e-5)
    assert clipped == pytest.approx(1 / 3)
    assert doubt([0.0] * 3, [0.0] * 3)[0] == pytest.approx(1.0)
    assert doubt([0.0] * 3, [0.3] * 3)[0] == pytest.approx(MAX_STOPS + 1)


def wall(x, exposure):
    """One opaque Gaussian, 2 in front of CAMERA's kind, that fills the pixels about x; all harmonics but the first are
    0."""
    points = torch.tensor([[x, 0.0, 2.0]])
    gaussians = Gaussians.from_points(points, torch.full((1, 3), float(np.log(exposure))), 0, opacity=0.99)
    gaussians.log_scales.data.fill_(np.log(0.05))
    return gaussians


def field(device="cpu"):
    """A Gaussian left of the middle, one right of it, and one behind the camera."""
    left, right, behind = wall(-0.4, 0.25), wall(0.4, 3.0), wall(0.0, 1.0)
    behind.means.data[:, 2] = -2
    left.append(right.tensors())
    left.append(behind.tensors())
    return RadianceField(left, SRGB, base_time=0.5).to(device)


def view(model, mask=None):
    photo = model.render_ldr(CAMERA).cpu().numpy()
    return View("v", codes_of(photo, 8), CAMERA, 0.5, "train", mask)


def test_weighted_sums_are_those_of_the_blend(device):
    model = field(device)
    images = torch.rand(12, 20, 2, generator=torch.Generator().manual_seed(0)).to(device)
    camera, gaussians = CameraTensors.of(CAMERA, device), model.gaussians
    sums = model.weighted_sums(camera, images)
    for index in range(3):
        alone = torch.zeros(3, 3, device=device)
        alone[index] = 1.0
        shapes = gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacities()
        weights = rasterize(*shapes, alone, camera.world_to_camera, camera.intrinsics, 20, 12).image[..., 0]
        torch.testing.assert_close(sums[index], (weights[..., None] * images).sum((0, 1)), rtol=1e-4, atol=1e-4)
    assert sums[2].abs().max() == 0 < sums[:2].min()


def test_weighted_sums_differentiate_the_features_alone(monkeypatch):
    model, inputs = field(), []
    monkeypatch.setattr(
        model, "rasterizer", lambda *tensors, **options: inputs.extend(tensors) or rasterize(*tensors, **options)
    )
    model.weighted_sums(CameraTensors.of(CAMERA, "cpu"), torch.ones(12, 20, 2))
    assert [tensor.requires_grad for tensor in inputs[:5]] == [False] * 4 + [True]


def test_clipped_and_unseen_gaussians_are_doubted(device):
    model = field(device)
    evidence = gather_evidence(model, [view(model)])
    left, right, behind = evidence.confidence().tolist()
    assert left > 0.9 and 0.4 < right < 0.75 and behind == 0
    assert evidence.clipped[0] < 0.01 and evidence.clipped[1] > 0.5
    assert evidence.weight_sum[2] == 0 < evidence.weight_sum[0]
    half = gather_evidence(model, [view(model, np.repeat(np.arange(20)[None] >= 10, 12, 0).astype(np.float32))])
    assert half.confidence()[0] == 0 and float(half.confidence()[1]) == pytest.approx(right, abs=0.02)


def test_truth_is_not_clipped():
    model = field()
    truth = View("v", codes_of(np.ones((12, 20, 3))), CAMERA, 0.5, "train", None, model.render(CAMERA).hdr.numpy())
    confidence = gather_evidence(model, [truth], truth=True).confidence()
    assert confidence[:2].min() > 0.99
    assert gather_evidence(model, [truth]).confidence()[1] < 0.6


def test_confidence_of_evidence():
    weights, stops = torch.tensor([0.0, HALF_CONFIDENCE_PIXELS, 1e6]), torch.tensor([0.0, 1.0, 1.0])
    evidence = Evidence(weights, stops, torch.zeros(3), torch.ones(3), torch.zeros(3))
    torch.testing.assert_close(evidence.confidence(), torch.tensor([0.0, 0.25, 0.5]))


def test_the_map_is_the_mean_of_what_is_seen(device):
    model = field(device)
    assert model.render_confidence(CAMERA) is None
    model.confidence = torch.tensor([0.9, 0.2, 1.0], device=device)
    confidence_image = model.render_confidence(CAMERA)
    assert confidence_image.shape == (12, 20)
    alpha = model.render(CAMERA).alpha
    assert float(confidence_image[6, 7]) == pytest.approx(0.9, abs=1e-4)
    assert float(confidence_image[6, 12]) == pytest.approx(0.2, abs=1e-4)
    assert bool((confidence_image[alpha <= 1e-3] == 0).all()) and bool((alpha <= 1e-3).any())
    assert not [name for name in model.state_dict() if "confidence" in name]


def test_doubt_of_clipped_light_is_the_deviation_of_its_estimate():
    photo, exposure = torch.ones(1, 4, 3), torch.full((1, 4, 3), 8.0)
    photo[0, 3, 1:] = 0.5
    exposure[0, 3, 1:] = SRGB.decode(photo[0, 3, 1:])
    deviation = torch.tensor([0.4, torch.inf, 50.0, 3.0])[None, :, None].expand(1, 4, 3)
    stops, _, _ = pixel_uncertainty(photo, exposure, SRGB, deviation)
    assert stops[0, :3].tolist() == pytest.approx([0.4, CLIPPED_STOPS, MAX_STOPS])
    # A saturated lamp clips one channel, which may be far above white. Codes of the others round by 0.01 stops.
    assert stops[0, 3] == pytest.approx(3.0 / 3, abs=0.01)
    assert pixel_uncertainty(photo, exposure, SRGB)[0][0, 3] == pytest.approx(PARTLY_CLIPPED_STOPS / 3, abs=0.01)


def test_estimates_of_views_reach_the_confidence_of_what_they_show():
    model = field()
    white_view = replace(view(model), codes=np.full((12, 20, 3), 255, np.uint8))
    high, low, none = (
        gather_evidence(model, [white_view], certainties=[torch.full((3, 5, 3), value, dtype=torch.float16)]).stops[0]
        for value in (8.0, 0.8, 0.0)
    )
    assert low - high == pytest.approx((1 / 0.8 - 1 / 8) / np.log(2), rel=1e-2)
    assert none == gather_evidence(model, [white_view]).stops[0]


@pytest.mark.parametrize("finer", [1, 2])
def test_a_picture_and_its_data_are_one_rasterization_of_the_same_bits(device, finer, monkeypatch):
    model, share = field(device), torch.tensor([0.1, 0.6, 0.3], device=device)
    model.confidence = torch.tensor([0.9, 0.2, 1.0], device=device)
    scene = Splats(Path("scene.ply"), model, ())
    monkeypatch.setattr(scene, "clipped_share", lambda: share)
    monkeypatch.setattr(scene, "samples_across_pixel", lambda camera: finer)
    whole, calls = scene.render(CAMERA), []
    monkeypatch.setattr(model, "rasterizer", lambda *args, **options: calls.append(1) or rasterize(*args, **options))
    view = scene.render(CAMERA, data=("confidence", "clipped"))
    assert len(calls) == (1 if finer == 1 else 3)
    assert all(torch.equal(getattr(view, name), getattr(whole, name)) for name in ("hdr", "alpha", "depth"))
    assert torch.equal(view.confidence, scene.render_confidence(CAMERA))
    assert torch.equal(view.clipped, scene.render_clipped(CAMERA))
    assert whole.confidence is None and whole.clipped is None
    model.confidence = None
    assert scene.render(CAMERA, data=["confidence"]).confidence is None
    with pytest.raises(InputError, match="data: has 'depth'; name any of confidence, clipped"):
        scene.render(CAMERA, data=("confidence", "depth"))
