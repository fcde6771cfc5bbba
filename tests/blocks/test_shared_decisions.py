"""Decisions that a block takes from the whole set: base time and the compensation of its photos."""

import pytest

from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.scene.exposure.compensation import ExposureCompensation
from sehdr_warp.training.compensation import SharedDecisions
from sehdr_warp.training.train import create_trainer

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
