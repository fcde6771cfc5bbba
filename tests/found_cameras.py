"""Bare photos whose cameras structure from motion finds as a test says, in a second."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from sehdr_warp.scene import Camera, View
from sehdr_warp.scene.dataparser import PointCloud
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.readers import bare_photos
from sehdr_warp.scene.readers.colmap_model import ModelImage, SparseModel
from sehdr_warp.scene.sfm.reconstruction import Reconstruction


def write_bare_photos(folder: Path, views: Sequence[View]) -> dict[str, Camera]:
    """Write photos of views without poses; return their cameras by stem."""
    folder.mkdir()
    for view in views:
        Image.fromarray((view.image * 255).astype(np.uint8)).save(folder / f"{view.name}.png")
    return {view.name: view.camera for view in views}


def find_cameras(monkeypatch, cameras, k1=0.02, points=None):
    """Let structure from motion find these cameras, by the photos' stems, with a lens that is not a pinhole."""

    def reconstruct(photos, *_):
        images = []
        for index, photo in enumerate(photos):
            if camera := cameras.get(photo.stem):
                params = (camera.fx, camera.cx, camera.cy, k1)
                lens = Lens("SIMPLE_RADIAL", camera.width, camera.height, params, photo)
                images.append(ModelImage(f"{index:05d}.png", lens, camera.world_to_camera))
        cloud = np.random.default_rng(0).uniform(-1, 1, (50, 3)) if points is None else points
        return Reconstruction(SparseModel(tuple(images), PointCloud(cloud, np.ones(cloud.shape, np.float32))), 0.5, ())

    monkeypatch.setattr(bare_photos, "reconstruct", reconstruct)


TURN = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])


def in_other_world(camera):
    """The camera in a world that is turned, three times as large and moved."""
    pose = camera.world_to_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ TURN.T
    pose[:3, 3] = -pose[:3, :3] @ (3 * TURN @ camera.position + [1, 2, 3])
    return replace(camera, world_to_camera=pose)
