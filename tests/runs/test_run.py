"""Runs and files of Gaussians as scenes to render."""

import json

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.runs.run import load_run, load_splats


def test_a_coarse_view_is_the_mean_of_finer_pixels_with_its_data(embedded_run):
    run = load_run(embedded_run)
    camera = run.cameras[0].camera
    half = camera.resized(camera.width // 2, camera.height // 2)
    factor = run.samples_across_pixel(half)
    assert run.samples_across_pixel(camera) == 1 < factor
    fine = run.render(half.resized(factor * half.width, factor * half.height)).hdr
    mean = fine.reshape(half.height, factor, half.width, factor, 3).mean((1, 3))
    coarse = run.render(half, data=("confidence", "clipped"))
    torch.testing.assert_close(coarse.hdr, mean, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(coarse.confidence, run.render_confidence(half))
    torch.testing.assert_close(coarse.clipped, run.render_clipped(half))
    assert not torch.allclose(run.render(half, supersample=False).hdr, mean, rtol=1e-4, atol=1e-5)
    with pytest.raises(InputError, match="data: has 'normals'; name any of confidence, clipped"):
        run.render(camera, data=("normals",))
    with pytest.raises(InputError, match="data: has 'normals'; name any of confidence, clipped"):
        run.render(camera, data="normals")
    for wrong in (run.cameras[0], run.cameras[0].name, None):
        with pytest.raises(TypeError, match=rf"camera is a {type(wrong).__name__}, expected a Camera, as run.cameras"):
            run.render(wrong)
    for time in (0, -1.0, float("nan"), float("inf"), "1/125"):
        with pytest.raises(ValueError, match=r"exposure_time is .*, expected seconds, such as 1 / 125"):
            run.render_ldr(camera, time)


def test_a_run_knows_what_its_folder_holds(embedded_run):
    run = load_run(embedded_run)
    assert repr(run) == f"Run('{embedded_run}', {run.gaussian_count:,} Gaussians, 27 views, on cpu)"
    assert (run.iterations, run.scene_name, run.is_paged) == (30, "embedded", False)
    assert run.summary()["finished"] and run.metrics()[-1]["iteration"] == 30
    assert sum(entry.split == "train" for entry in run.cameras) == 18


def test_a_file_of_gaussians_is_a_scene_with_the_cameras_beside_it(embedded_run, tmp_path, logged):
    run = load_run(embedded_run)
    export(run, tmp_path / "a.ply", kind="hdr", cameras=True, axes="scene")
    splats = load_splats(tmp_path / "a.ply")
    assert splats.base_time == run.base_time and len(splats.cameras) == 27
    camera = run.cameras[0].camera
    np.testing.assert_allclose(splats.render(camera).hdr, run.render(camera).hdr, rtol=0.02, atol=0.02)
    assert splats.render_confidence(camera) is splats.clipped_share() is None
    with pytest.raises(SehdrError, match=r"a\.ply: holds no record of .*; lights are found in the folder of a run"):
        splats.find_lights()
    beside = tmp_path / "a.ply.cameras.json"
    (tmp_path / "cameras.json").write_text(json.dumps(json.loads(beside.read_text())[:2]))
    beside.unlink()
    assert len(load_splats(tmp_path / "a.ply").cameras) == 2
    assert any("2 cameras from" in line and "does not say what it belongs to" in line for line in logged)
