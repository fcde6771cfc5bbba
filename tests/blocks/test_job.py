"""One block: decisions of the whole set, and machines with other versions or photos."""

import numpy as np
import pytest
import torch

from benchmarks.survey import write_survey
from sehdr_warp.blocks.block_plan import BlockPlan, make_block_plan
from sehdr_warp.blocks.job import folder_of, load_block_scene, train_block
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.exposure.compensation import ExposureCompensation
from sehdr_warp.training.compensation import SharedDecisions
from sehdr_warp.training.launch import installed_versions
from sehdr_warp.training.train import create_trainer

from ..found_cameras import TURN, find_cameras, in_other_world, write_bare_photos
from ..training.toy import EXPOSURE_TIME, VARIANTS, toy_scene


def test_a_block_is_trained_with_the_decisions_of_the_set(tmp_path):
    scene = toy_scene()
    gains = {view.name: (2.0 if view.name == "v_0" else 1.0,) * 3 for view in scene.views} | {"elsewhere": (1.5,) * 3}
    shared = SharedDecisions(3 * EXPOSURE_TIME, ExposureCompensation(gains))
    trainer = create_trainer(scene, tmp_path / "run", VARIANTS["default"], device="cpu", shared=shared)
    info = RunFolder(tmp_path / "run").read_info()
    assert info["base_time"] == trainer.field.base_time == pytest.approx(3 * EXPOSURE_TIME)
    assert info["exposure_compensation"]["gains"].keys() == {view.name for view in scene.views}
    times = {view.name: view.exposure_time for view in trainer.scene.views}
    assert times["v_0"] == pytest.approx(2 * EXPOSURE_TIME) and times["v_1"] == pytest.approx(EXPOSURE_TIME)


def test_without_drift_nothing_is_compensated():
    assert SharedDecisions(1.0, None).compensation_of(toy_scene().views) is None


def test_blocks_of_bare_photos_stay_in_the_world_of_the_set(tmp_path, monkeypatch):
    """A node that finds cameras anew, or a later version, finds another world."""
    write_survey(tmp_path / "town", views=32, size=48, gaussians=6000)
    town = load_scene(tmp_path / "town", response="srgb")
    cameras, points = write_bare_photos(tmp_path / "photos", town.views), town.points
    find_cameras(monkeypatch, cameras, points=points)
    config = load_config("demo", {"response.name": "srgb"})
    data = {"path": str(tmp_path / "photos"), "exposure_index": None, "max_size": None, "holdout": None}
    plan = make_block_plan(data, config, torch.device("cpu"), 2)
    assert plan is not None
    before = [load_block_scene(plan, index) for index in range(2)]
    plan.write(tmp_path)
    others = {name: in_other_world(camera) for name, camera in cameras.items()}
    find_cameras(monkeypatch, others, points=3 * points @ TURN.T + [1, 2, 3])
    for index, scene in enumerate(before):
        after = load_block_scene(BlockPlan.read(tmp_path), index)
        assert len(scene.points) > 0
        np.testing.assert_allclose(after.points, scene.points, atol=1e-9)
        for view, other in zip(scene.views, after.views, strict=True):
            np.testing.assert_array_equal(view.camera.world_to_camera, other.camera.world_to_camera)


def test_a_machine_with_other_versions_trains_nothing(divided):
    folder, plan = divided
    result = train_block(folder / "run", 0, "cpu", "sehdr-warp 0.1")
    assert f"it has {installed_versions()}, and the command was started with sehdr-warp 0.1" in result.error
    assert not folder_of(folder / "run", plan, 0).exists()


def test_a_machine_with_other_photos_trains_nothing(divided):
    folder, plan = divided
    photo = folder / "town" / "images" / f"{plan.blocks[0].views[1]}.png"
    before = photo.read_bytes()
    photo.write_bytes(before + b"more")
    try:
        result = train_block(folder / "run", 0, "cpu", installed_versions())
    finally:
        photo.write_bytes(before)
    sizes = f"has {len(before) + 4} bytes, and had {len(before)} when the set was divided"
    assert f"{photo.stem} {sizes}; copy the same set to all nodes" in result.error
    assert not folder_of(folder / "run", plan, 0).exists()
