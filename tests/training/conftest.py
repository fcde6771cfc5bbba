"""Scenes small enough to train on in seconds, and trainings of them that tests share."""

import shutil
from functools import cache
from pathlib import Path

import pytest

from sehdr_warp.training.scene_facts import measure_scene
from sehdr_warp.training.train import create_trainer

from ..make_scenes import write_blender
from .toy import VARIANTS, toy_scene, without_truth


@pytest.fixture(autouse=True)
def quickly(few_probes):
    """Whatever is trained here is small."""


@pytest.fixture(scope="session")
def scene():
    return toy_scene()


@pytest.fixture(scope="session")
def facts(scene):
    return measure_scene(scene)


@pytest.fixture(scope="session")
def photos(tmp_path_factory):
    """The folder of six photos of 40 x 30 pixels, with poses; not to be changed."""
    folder = tmp_path_factory.mktemp("photos")
    write_blender(folder)
    return folder


@pytest.fixture(scope="session")
def trained(scene, tmp_path_factory):
    """trained(variant): the folder of a finished run of VARIANTS; beside it lies `killed`, what a kill at iteration 66
    would have left. Neither is to be changed."""

    @cache
    def train(variant: str) -> Path:
        folder, config = tmp_path_factory.mktemp("trained"), VARIANTS[variant]
        # What trains without truth trains without any there.
        training_scene = scene if config.loss.uses_hdr else without_truth(scene)
        for step in create_trainer(training_scene, folder / "run", config, device="cpu", data={"path": "somewhere"}):
            if step.iteration == 66:
                shutil.copytree(folder / "run", folder / "killed")
        return folder / "run"

    return train
