"""Detail of a photo that each Gaussian shows."""

import numpy as np
import torch

from sehdr_warp.rasterizer import rasterize
from sehdr_warp.training.photo_detail import edges, visible_detail
from sehdr_warp.training.targets import CODE

from .toy import VARIANTS, make_trainer, toy_scene


def test_edges_are_differences_between_neighbors():
    image = torch.zeros(3, 4, 3)
    image[1:, 2:] = torch.tensor([0.3, 0.6, 0.9])
    expected = torch.zeros(3, 4)
    expected[1:, 1] = 0.6
    expected[0, 2:] = 0.6
    assert torch.allclose(edges(image), expected)
    assert edges(torch.rand(1, 1, 3)).tolist() == [[0.0]]


def test_a_gaussian_counts_by_the_detail_of_the_pixels_that_it_shows():
    """Against one render for each Gaussian, in which it alone is white."""
    trainer = make_trainer(toy_scene(), VARIANTS["default"])
    view = trainer.views.source[0]
    mask = torch.ones(32, 32, 1)
    mask[:, :12] = 0
    codes = view.target.codes
    for weights in (None, mask):
        object.__setattr__(view.target, "mask", weights)
        photo = codes.numpy().astype(np.float64).mean(2) / 255
        gradient = np.zeros_like(photo), np.zeros_like(photo)
        gradient[0][:, :-1], gradient[1][:-1] = np.diff(photo, axis=1), np.diff(photo, axis=0)
        detail = np.hypot(*gradient) + CODE
        if weights is not None:
            detail = detail * weights[..., 0].numpy()
        field, measured = trainer.field, visible_detail(trainer.field, view)
        g, camera, white = field.gaussians, view.camera, torch.eye(field.gaussians.count)
        with torch.no_grad():
            shapes = g.means, g.log_scales, g.quaternions, g.opacities()
            pose = camera.world_to_camera, camera.intrinsics, camera.width, camera.height
            images = torch.cat([rasterize(*shapes, part, *pose).image for part in white.split(8, dim=1)], 2)
        expected = np.einsum("hw,hwn->n", detail, images.double().numpy())
        assert expected.max() > 0.1 and np.abs(measured.numpy() - expected).max() < 1e-4 * expected.max()
