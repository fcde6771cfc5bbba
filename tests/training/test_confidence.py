"""The confidence of a run: measured at its end, kept beside its checkpoint, refused where damaged, and not needed to
load."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from sehdr_warp.errors import InputError
from sehdr_warp.runs import open as opening
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import confidence_metadata
from sehdr_warp.scene import codes_of
from sehdr_warp.training.train import train


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    config = load_config("demo", {"schedule.iterations": 6, "response.name": "srgb"})
    return train(scene, tmp_path_factory.mktemp("run") / "run", config, device="cpu")


@pytest.fixture
def run(trained, tmp_path):
    shutil.copytree(trained.path, tmp_path / "run")
    return load_run(tmp_path / "run")


def test_a_training_leaves_its_confidence(trained, scene):
    confidence = load_run(trained.path).field.confidence
    assert torch.equal(confidence, trained.field.confidence)
    assert confidence.shape == (trained.gaussian_count,) and 0 <= confidence.min() < confidence.max() <= 1
    saved = load_file(trained.folder.confidence)
    assert sorted(saved) == ["clipped", "clipped_stops", "peak", "seen", "stops"]
    confidence_image = trained.render_confidence(scene.test_views[0].camera)
    assert confidence_image.shape == (32, 32) and 0 < confidence_image.max() <= 1


@pytest.mark.parametrize(("gain", "least", "most"), [(0.5, 0, 0), (50, 0.8, 1)])
def test_a_summary_states_which_share_of_the_light_is_an_estimate(scene, tmp_path, gain, least, most):
    views = tuple(replace(view, codes=codes_of(np.minimum(gain * view.image, 1))) for view in scene.views)
    config = load_config("demo", {"schedule.iterations": 1, "response.name": "srgb"})
    run = train(replace(scene, views=views), tmp_path / "run", config, device="cpu")
    assert least <= run.summary()["estimated_light"] <= most


def test_a_run_without_it_gets_it_on_demand(run, scene, caplog, monkeypatch):
    monkeypatch.setattr(opening, "load_run_scene", lambda *_: scene)
    expected = run.field.confidence
    run.folder.confidence.unlink()
    run = load_run(run.path)
    assert run.field.confidence is None and run.render_confidence(scene.test_views[0].camera) is None
    caplog.set_level("INFO")
    opening.load_run_scene_with_confidence(run, None)
    torch.testing.assert_close(run.field.confidence, expected)
    torch.testing.assert_close(load_run(run.path).field.confidence, expected)
    assert torch.equal(run.clipped_share(), load_run(run.path).clipped_share())
    opening.load_run_scene_with_confidence(run, None)
    assert caplog.text.count("measuring confidence") == 1


def test_a_run_keeps_what_was_measured_of_its_own_gaussians(run):
    """A training that goes on may replace the file of a run that is open."""
    clipped = run.clipped_share()
    assert clipped is not None and clipped.shape == (run.gaussian_count,)
    metadata = {"sehdr_warp": json.dumps(confidence_metadata("0" * 64))}
    save_file({"confidence": torch.ones(3), "clipped": torch.ones(3)}, run.folder.confidence, metadata)
    assert torch.equal(run.clipped_share(), clipped)


def test_that_of_another_checkpoint_does_not_count(run):
    metadata = {"sehdr_warp": json.dumps(confidence_metadata("0" * 64))}
    save_file({"confidence": run.field.confidence}, run.folder.confidence, metadata)
    other = load_run(run.path)
    assert other.field.confidence is None and other.clipped_share() is None


@pytest.mark.parametrize(
    "clipped, problem",
    [(torch.zeros(3), "shape"), (None, "outside of 0 to 1"), (b"\x00" * 40, "not a file of confidence")],
    ids=["short", "values", "damaged"],
)
def test_damage_is_one_line(run, clipped, problem):
    metadata = {"sehdr_warp": json.dumps(confidence_metadata(run.checkpoint_hash))}
    if isinstance(clipped, bytes):
        run.folder.confidence.write_bytes(clipped)
    else:
        values = torch.full_like(run.clipped_share(), torch.nan) if clipped is None else clipped
        stored = load_file(run.folder.confidence)
        save_file(stored | {"clipped": values}, run.folder.confidence, metadata)
    with pytest.raises(InputError, match=problem) as error:
        load_run(run.path)
    assert run.folder.confidence.name in str(error.value) and "report" in str(error.value)
