"""Estimates for panoramas and wide fisheye photos, by perspective faces."""

import numpy as np
import pytest
import torch

from sehdr_warp.prior import load_prior
from sehdr_warp.prior.estimate import LARGEST, LightEstimate
from sehdr_warp.runs.wide_prior import WidePrior
from sehdr_warp.scene import Camera
from sehdr_warp.scene.wide_camera import pixel_directions


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
    result = WidePrior(Echo(), camera).estimate(smooth, torch.ones_like(smooth, dtype=torch.bool))
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
    prior = WidePrior(echo, camera)
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
    wide = WidePrior(prior, camera)
    first = wide.estimate(exposure, clipped).mean[50:58, 124:132]
    for shift in (32, 128):  # By 45 degrees, and onto the seam
        moved = wide.estimate(exposure.roll(shift, 1), clipped.roll(shift, 1)).mean.roll(-shift, 1)
        assert torch.allclose(moved[50:58, 124:132], first, atol=0.05)
    assert first.mean() > 0.3


def test_cameras_of_another_pose_share_faces():
    moved = np.eye(4)
    moved[:3, 3] = 1, 2, 3
    prior = WidePrior(Echo(), panorama())
    assert prior.fits(Camera(128, 64, 128 / (2 * np.pi), 128 / (2 * np.pi), 64, 32, moved, "equirectangular"))
    assert not prior.fits(panorama(256)) and not prior.fits(fisheye())
