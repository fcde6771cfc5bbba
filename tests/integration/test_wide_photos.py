"""Perspective views of a scene that fisheye photos show are drawn as these photos trained it."""

import math

import numpy as np
import pytest
import torch

from sehdr_warp.model.paged_field import PagedField
from sehdr_warp.model.pixel_filter import RayLimits
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.merged_scene import merge_scenes
from sehdr_warp.output.scene_page import write_scene_page
from sehdr_warp.runs.run import load_splats
from sehdr_warp.scene import Camera, Scene, View, codes_of, look_at
from sehdr_warp.scene.wide_camera import solid_angles
from sehdr_warp.training.train import create_trainer

from ..training.toy import EXPOSURE_TIME, toy_field

SIZE = 32


def camera_inside(angle, wide):
    """A camera near the cloud: a fisheye of 140 degrees across, or a pinhole of 100."""
    half = SIZE / 2
    focal = half / math.radians(70) if wide else half / math.tan(math.radians(50))
    lens = ("OPENCV_FISHEYE", (0.0,) * 4) if wide else ()
    pose = look_at([1.6 * math.cos(angle), 1.6 * math.sin(angle), 0.5])
    return Camera(SIZE, SIZE, focal, focal, half, half, pose, *lens)


def photo(field, index):
    wide = index % 3 != 2
    camera = camera_inside(2 * math.pi * index / 9, wide)
    mask = solid_angles(camera) if wide else None
    split = "train" if wide else "test"
    return View(f"v_{index}", codes_of(field.render_ldr(camera).numpy(), 8), camera, EXPOSURE_TIME, split, mask)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A training on fisheye photos of the toy cloud, and the held-out pinhole photos."""
    field = toy_field()
    field.photo_cameras = [camera_inside(0, wide=True)]
    views = tuple(photo(field, index) for index in range(9))
    points = field.gaussians.means.detach().numpy().astype(np.float64)
    scene = Scene("toy", "transforms", views, points, np.full(points.shape, 0.5, np.float32))
    config = {"schedule.iterations": 60, "plan.enabled": False, "response.name": "srgb"}
    trainer = create_trainer(scene, tmp_path_factory.mktemp("wide") / "run", config, device="cpu")
    return trainer, trainer.train(), scene.test_views


def mean_psnr(scene, views):
    errors = [np.mean((scene.render_ldr(view.camera).numpy() - view.image) ** 2) for view in views]
    return float(np.mean(-10 * np.log10(errors)))


def test_held_out_pinholes_are_nearer_than_linearized(trained, monkeypatch):
    _, run, views = trained
    along_rays = mean_psnr(run, views)
    monkeypatch.setattr(run.field, "along_rays", False)
    monkeypatch.setattr(run.field, "ray_limits", RayLimits(math.inf, math.inf))
    assert mean_psnr(run, views) < along_rays - 0.5


def test_pictures_of_the_training_and_of_merged_runs_are_those_of_the_run(trained):
    trainer, run, (view, *_) = trained
    expected = run.render(view.camera).hdr
    torch.testing.assert_close(trainer.render(view.camera).hdr, expected, rtol=0.05, atol=0.05)
    assert merge_scenes(run, run).field.along_rays


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".glb", ".usdc", ".sog"])
def test_files_are_drawn_as_the_run_is(trained, tmp_path, monkeypatch, suffix):
    if suffix == ".usdc":
        pytest.importorskip("pxr")
    _, run, views = trained
    scene = load_splats(export(run, tmp_path / f"scene{suffix}", axes="scene"))
    along_rays = mean_psnr(scene, views)
    assert along_rays == pytest.approx(mean_psnr(run, views), abs=1.0)
    camera = views[0].camera
    paged = PagedField(scene.field, torch.device("cpu"), budget=10**9)
    torch.testing.assert_close(paged.render(camera).hdr, scene.field.render(camera).hdr)
    monkeypatch.setattr(scene.field, "along_rays", False)
    assert mean_psnr(scene, views) < along_rays - 0.5


def test_pages_which_draw_no_rays_keep_gaussians_beside_the_view_out_of_it(trained, tmp_path):
    run = trained[1]
    for scene in (run, load_splats(export(run, tmp_path / "scene.ply"))):
        page = write_scene_page(scene, tmp_path / "scene.html", overwrite=True)
        assert '"rays": [0.3, 0.3]' in page.read_text()
