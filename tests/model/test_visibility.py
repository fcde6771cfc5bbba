from copy import copy

import numpy as np
import torch

from sehdr_warp.model.visibility import contributions, count_views
from sehdr_warp.runs.run import load_run
from sehdr_warp.scene.normalization import Normalization


def test_gaussians_of_a_trained_run_are_counted_in_its_own_coordinates(embedded_run):
    """The same Gaussians and cameras in other coordinates: as many cameras show each Gaussian."""
    run = load_run(embedded_run, device="cpu")
    field, cameras = run.field, [entry.camera for entry in run.cameras if entry.split == "train"][::3]
    assert not field.normalization.is_identity
    plain = copy(field)
    plain.normalization = Normalization()
    plain.photo_cameras = [field.normalization.camera(camera) for camera in field.photo_cameras]
    normalized = [field.normalization.camera(camera) for camera in cameras]
    views = count_views(field, cameras)
    assert float((views > 0).float().mean()) > 0.8
    torch.testing.assert_close(views, count_views(plain, normalized))
    np.testing.assert_allclose(contributions(field, cameras), contributions(plain, normalized), rtol=1e-4)
