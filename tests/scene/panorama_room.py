"""A box with painted walls, and panoramas of it from known places."""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from sehdr_warp.scene.camera import Camera
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.wide_camera import pixel_directions


def walls(side=512, seed=0):
    """[6, side, side, 3] light: blots of several sizes."""
    random = np.random.default_rng(seed)
    sizes = 1.5, 4, 12
    noise = [gaussian_filter(random.standard_normal((6, side, side, 3)), (0, s, s, 0)) * s for s in sizes]
    return np.clip(0.35 + 0.45 * sum(noise), 0.02, 1.0)


def camera_at(position, turn=0.0, width=512):
    """A panorama's camera, turned about the vertical axis."""
    pose, c, s = np.eye(4), np.cos(turn), np.sin(turn)
    pose[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    pose[:3, 3] = -pose[:3, :3] @ position
    return Lens("EQUIRECTANGULAR", width, width // 2, (width, width // 2), "test").camera(pose)


def light(camera: Camera, painted: np.ndarray) -> np.ndarray:
    """[H, W, 3] light that a camera within the box (from -1 to 1) sees."""
    directions = pixel_directions(camera) @ camera.world_to_camera[:3, :3]
    directions = np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    reach = (np.sign(directions) - camera.position) / directions
    axis = reach.argmin(axis=2)
    place = camera.position + directions * reach.min(axis=2, keepdims=True)
    wall = 2 * axis + (np.take_along_axis(directions, axis[..., None], 2)[..., 0] > 0)
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    across = (np.take_along_axis(place, others, 2) + 1) / 2 * (painted.shape[1] - 1)
    at = np.stack([wall.astype(float), across[..., 0], across[..., 1]])
    return np.stack([map_coordinates(painted[..., c], at, order=1, mode="nearest") for c in range(3)], axis=2)
