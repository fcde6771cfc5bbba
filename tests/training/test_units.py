"""A training does not depend on the unit and the origin of the world that a scene comes in."""

from dataclasses import replace

import numpy as np
import torch

from sehdr_warp.model.baking import field_of, gaussians_of
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.scene import Scene
from sehdr_warp.splats import read_gaussians
from sehdr_warp.training.train import train

from .toy import load_unscaled, toy_scene

CONFIG = load_unscaled(overrides={"schedule.iterations": 60, "response.name": "srgb", "plan.enabled": False})


def moved(scene: Scene, scale: float, shift: np.ndarray) -> Scene:
    """The scene with its world multiplied and then moved."""
    views = []
    for view in scene.views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ (scale * view.camera.position + shift)
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    return replace(scene, views=tuple(views), points=scale * scene.points + shift)


def test_unit_and_origin_do_not_matter(tmp_path):
    scene = toy_scene()
    plain = train(scene, tmp_path / "plain", CONFIG, device="cpu")
    for scale, shift in ((16.0, np.zeros(3)), (0.01, np.zeros(3)), (1.0, np.array([500_000.0, 4_200_000.0, 100.0]))):
        other = moved(scene, scale, shift)
        run = train(other, tmp_path / f"moved {scale} {shift[0]}", CONFIG, device="cpu")
        for view, same in zip(scene.test_views, other.test_views, strict=True):
            one, two = plain.render(view.camera), run.render(same.camera)
            torch.testing.assert_close(two.hdr, one.hdr, rtol=1e-3, atol=1e-4)
            torch.testing.assert_close(two.depth, one.depth * scale, rtol=1e-3, atol=1e-3 * scale)
            np.testing.assert_allclose(run.cameras[0].camera.position, other.views[0].camera.position)
        # What is exported is in the coordinates of the scene.
        ours, theirs = (gaussians_of(r.field, "linear", np.zeros((0, 3))) for r in (plain, run))
        spread = np.abs(scale * ours.means + shift - theirs.means).max()
        assert spread < 1e-4 * scale + 1e-6 * np.abs(shift).max()
        np.testing.assert_allclose(theirs.log_scales, ours.log_scales + np.log(scale), atol=1e-3)


def test_far_coordinates_are_exported_relative_to_the_scene(tmp_path, caplog):
    scene = moved(toy_scene(), 1.0, np.array([500_000.0, 4_200_000.0, 100.0]))
    run = train(scene, tmp_path / "run", CONFIG, device="cpu")
    export(run, tmp_path / "upright.ply", kind="ldr")
    assert "too large for the float32" not in caplog.text
    assert np.abs(read_gaussians(tmp_path / "upright.ply").means).max() < 1000
    # Gaussians in the coordinates of the set keep what float32 would lose.
    gaussians = gaussians_of(run.field, "linear", np.zeros((0, 3)))
    camera = scene.test_views[0].camera
    image = field_of(gaussians).render(camera).hdr
    torch.testing.assert_close(image, run.render(camera).hdr, rtol=0.1, atol=0.02)
    export(run, tmp_path / "scene.ply", axes="scene", kind="ldr")
    assert "too large for the float32" in caplog.text
