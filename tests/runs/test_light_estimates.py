"""Estimates of clipped light as a training takes them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.prior import load_prior
from sehdr_warp.prior.estimate import LARGEST, LightEstimate
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import LossConfig
from sehdr_warp.runs.light_estimates import FacePrior, light_estimates
from sehdr_warp.scene import Camera, View
from sehdr_warp.scene.wide_camera import pixel_directions, solid_angles
from sehdr_warp.training.training_views import ViewDataset

SRGB = response_by_name("srgb")
CPU = torch.device("cpu")


def view(code, stated=None, deviation=0.0):
    """A photo 12 x 10 of one code; stated: light above white."""
    codes = np.full((10, 12, 3), code, np.uint8)
    above = None if stated is None else np.full(codes.shape, stated, np.float16)
    camera = Camera(12, 10, 12.0, 12.0, 6.0, 5.0, np.eye(4))
    return View("a", codes, camera, 1.0, "train", light_above_white=above, light_above_white_deviation=deviation)


def test_gain_maps_count_without_the_prior():
    views = [view(255, stated=4.0, deviation=0.5), view(100)]
    first, second = light_estimates(views, SRGB, LossConfig(light_prior=False), CPU)
    assert first.log_light[0, 0].tolist() == pytest.approx([np.log(4)] * 3 + [2.0] * 3, rel=1e-3)
    assert (second.log_light == 0).all() and second.log_light.shape == first.log_light.shape


@pytest.mark.parametrize(
    "loss", [LossConfig(clipped_estimate=0.0), LossConfig(clipping=False), LossConfig(light_prior=False)]
)
def test_nothing_is_estimated_that_does_not_count(loss):
    assert light_estimates([view(255)], SRGB, loss, CPU) is None


def test_nothing_is_estimated_where_nothing_clips_or_exposures_are_not_compared():
    assert light_estimates([view(254)], SRGB, LossConfig(), CPU) is None
    assert light_estimates([view(255, stated=4.0, deviation=0.5)], None, LossConfig(), CPU) is None


def test_targets_carry_the_estimates():
    views = [replace(view(255, stated=4.0, deviation=0.5), name=name) for name in "ab"]
    estimates = [known.log_light for known in light_estimates(views, SRGB, LossConfig(light_prior=False), CPU)]
    source = ViewDataset(views, 1.0, CPU, truth=False, response=SRGB, estimates=estimates)
    assert torch.equal(source[1].target.estimates, estimates[1])


def test_the_prior_estimates_photos_that_clip_alone():
    first, second = light_estimates([view(255), view(100)], SRGB, LossConfig(), CPU)
    assert (
        (first.log_light[..., 3:] > 0).all() and (first.log_light[..., :3] >= 0).all() and (first.certainty > 0).all()
    )
    assert (second.log_light == 0).all() and (second.certainty == 0).all()


def test_panoramas_are_seen_by_perspective_faces():
    """A face of 90 degrees has a quarter of the circle, so a panorama keeps more pixels than a photo of its size."""
    scale = 640 / (2 * np.pi)
    camera = Camera(640, 320, scale, scale, 320, 160, np.eye(4), "equirectangular")
    codes = np.full((320, 640, 3), 90, np.uint8)
    codes[150:170, 310:330] = 255
    photo = replace(view(0), codes=codes, camera=camera)
    first, second = light_estimates([photo, replace(photo, codes=codes // 2)], SRGB, LossConfig(), CPU)
    assert first.certainty.shape == second.certainty.shape and first.certainty.shape[0] > 200
    known = first.certainty[..., 0] > 0
    assert 0 < known.float().mean() < 0.01 and known[known.shape[0] // 2, known.shape[1] // 2]
    assert (second.log_light == 0).all()


def test_estimates_of_a_panorama_weigh_by_solid_angle_in_a_training():
    """A pixel beside a pole covers next to nothing of the sphere; the mean weight is that of a pinhole's pixels."""
    height, width = 16, 32
    scale = width / (2 * np.pi)
    camera = Camera(width, height, scale, scale, width / 2, height / 2, np.eye(4), "equirectangular")
    codes = np.full((height, width, 3), 255, np.uint8)
    above = np.full(codes.shape, 4.0, np.float16)
    photo = replace(view(0), codes=codes, camera=camera, light_above_white=above, light_above_white_deviation=0.5)
    (known,) = light_estimates([photo], SRGB, LossConfig(light_prior=False), CPU)
    assert known.certainty.unique().tolist() == [2.0]
    weights = (known.log_light[..., 3:].float() ** 2 / 4)[:, 0, 0]
    expected = solid_angles(camera)[:, 0] / solid_angles(camera).mean()
    assert weights.tolist() == pytest.approx(expected.reshape(len(weights), -1).mean(1).tolist(), rel=5e-3)
    assert weights.mean() == pytest.approx(1, rel=5e-3) and weights[0] < 0.2 * weights[len(weights) // 2]


class Echo:
    """A prior that returns the photo itself, to see where faces put it."""

    def __init__(self):
        self.sizes = []

    def estimate(self, exposure, clipped):
        self.sizes.append(tuple(exposure.shape[:2]))
        return LightEstimate(exposure, exposure + 1)


def panorama(width=128):
    return Camera(width, width // 2, width / (2 * np.pi), width / (2 * np.pi), width / 2, width / 4, np.eye(4),
                  "equirectangular")  # fmt: skip


def fisheye(size=120):
    return Camera(size, size, size / 3.2, size / 3.2, size / 2, size / 2, np.eye(4), "OPENCV_FISHEYE", (0.0,) * 4)


@pytest.mark.parametrize("camera", [panorama(), fisheye()], ids=["panorama", "fisheye"])
def test_faces_lie_where_the_photo_shows_them(camera):
    directions = np.nan_to_num(pixel_directions(camera))
    smooth = torch.tensor(0.5 + 0.3 * directions, dtype=torch.float32)
    result = FacePrior(Echo(), camera).estimate(smooth, torch.ones_like(smooth, dtype=torch.bool))
    has_direction = torch.tensor(np.isfinite(pixel_directions(camera)).all(axis=2))
    if camera.projection != "equirectangular":  # The border is blurred with the black around a picture
        has_direction[:6], has_direction[-6:], has_direction[:, :6], has_direction[:, -6:] = False, False, False, False
    inside = torch.nn.functional.max_pool2d(1 - has_direction[None].float(), 5, 1, 2)[0] == 0
    error = (result.mean - smooth).abs().amax(2)[inside]
    assert error.max() < 0.02 and error.mean() < 0.004
    assert torch.allclose(result.deviation[inside], result.mean[inside] + 1, atol=1e-4)


def test_large_panoramas_are_seen_by_small_faces_and_dark_faces_not_at_all():
    camera, echo = panorama(2048), Echo()
    exposure = torch.full((1024, 2048, 3), 0.25)
    clipped = torch.zeros(1024, 2048, 3, dtype=torch.bool)
    clipped[500:520, 1000:1040] = True  # In front
    prior = FacePrior(echo, camera)
    estimate = prior.estimate(exposure, clipped)
    assert estimate.mean.shape == (*prior.size(1024, 2048), 3) == (251, 503, 3)
    assert len(echo.sizes) == 3, "the face in front and its two neighbors"
    assert all(max(size) <= LARGEST for size in echo.sizes)


def test_a_lamp_is_estimated_alike_all_around_and_across_the_seam():
    camera, prior = panorama(256), load_prior("cpu")
    generator = torch.Generator().manual_seed(0)
    exposure = torch.rand(128, 1, 3, generator=generator).expand(128, 256, 3) * 0.3 + 0.05
    clipped = torch.zeros(128, 256, 3, dtype=torch.bool)
    clipped[50:58, 124:132] = True
    exposure = torch.where(clipped, 1.0, exposure)
    face_prior = FacePrior(prior, camera)
    first = face_prior.estimate(exposure, clipped).mean[50:58, 124:132]
    for shift in (32, 128):  # By 45 degrees, and onto the seam
        moved = face_prior.estimate(exposure.roll(shift, 1), clipped.roll(shift, 1)).mean.roll(-shift, 1)
        assert torch.allclose(moved[50:58, 124:132], first, atol=0.05)
    assert first.mean() > 0.3


def test_cameras_of_another_pose_share_faces():
    moved = np.eye(4)
    moved[:3, 3] = 1, 2, 3
    prior = FacePrior(Echo(), panorama())
    assert prior.fits(Camera(128, 64, 128 / (2 * np.pi), 128 / (2 * np.pi), 64, 32, moved, "equirectangular"))
    assert not prior.fits(panorama(256)) and not prior.fits(fisheye())
