"""Camera models and distortion as COLMAP has them."""

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene.lens import CAMERA_MODELS
from tests.make_scenes import load, write_colmap

pycolmap = pytest.importorskip("pycolmap")


def test_every_camera_model_has_pycolmaps_id_and_parameters():
    for number, (name, count) in CAMERA_MODELS.items():
        camera = pycolmap.Camera.create_from_model_name(1, name, 500.0, 64, 48)
        assert int(camera.model) == number and len(camera.params) == count


@pytest.mark.parametrize(
    "model, params, scale",
    [
        ("OPENCV", (50, 52, 30, 25, -0.1, 0.02, 1e-3, -2e-3), 1),
        ("SIMPLE_RADIAL", (50, 32, 24, -0.15), 1),
        ("SIMPLE_RADIAL", (500, 320, 240, -0.15), 8),
        ("FULL_OPENCV", (50, 52, 30, 25, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.02, 0, 0), 1),
        ("OPENCV_FISHEYE", (40, 40, 32, 24, 0.01, 0, 0, 0), 1),
        ("FOV", (50, 50, 32, 24, 0.4), 1),
    ],
)
def test_distortion_is_undone_where_pycolmap_projects(tmp_path, model, params, scale):
    """A photo that shows its own pixel places must, undistorted, show where pycolmap projects the rays: within
    the codes' precision, or within a quarter of a final pixel where it is averaged to an eighth before it is bent."""
    width, height = 64 * scale, 48 * scale
    write_colmap(tmp_path, model=model, params=params, size=(width, height))
    places = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.zeros((height, width))], axis=2)
    step = 1 if scale == 1 else width / 255
    for i in range(6):
        Image.fromarray((places / step + 0.5).astype(np.uint8)).save(tmp_path / "images" / f"{i:03d}.png")
    view = load(tmp_path, max_size=None if scale == 1 else width // scale, response="linear").views[2]
    camera, lens = view.camera, pycolmap.Camera(model=model, width=width, height=height, params=list(params))
    rows, columns = np.mgrid[2 : camera.height - 2 : 3, 2 : camera.width - 2 : 3].reshape(2, -1)
    rays = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, 0 * rows + 1.0], 1)
    colors = view.image[rows, columns, :2] * 255 * step + 0.5
    np.testing.assert_allclose(colors, lens.img_from_cam(rays), atol=0.02 if scale == 1 else 2)
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    if scale == 1:
        assert (camera.width, camera.height) == (pinhole.width, pinhole.height)
        np.testing.assert_allclose(camera.intrinsics, pinhole.params, rtol=1e-9)
