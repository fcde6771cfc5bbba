"""A response that is corrected while the scene is trained: held back, saved, loaded, shown, resumed."""

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.response import RefinedResponse
from sehdr_warp.training.config_files import load_config
from sehdr_warp.training.initialization import choose_response, make_field
from sehdr_warp.training.run import load_run
from sehdr_warp.training.train import train
from sehdr_warp.training.trainer import Trainer

from .test_train import QUICK


def configuration(**values):
    fixed = {
        "schedule.iterations": 40,
        "schedule.stated_for": 40,
        "densification.strategy": "none",
        "response.name": "srgb",
        "response.refine": True,
        "response.refine_after": 20,
        "optimizer.refinement": 0.01,
    }
    return load_config("default", QUICK | fixed | {name.replace("__", "."): value for name, value in values.items()})


def trainer(scene, config) -> Trainer:
    return Trainer(scene, config, make_field(scene, config, choose_response(scene, config), "cpu"))


def test_correction_is_held_back_and_then_learned(scene):
    training = trainer(scene, configuration())
    logs = training.field.response.log_densities
    for _ in range(20):
        training.step()
    assert not logs.any() and not training.field.response.refining
    for _ in range(5):
        training.step()
    assert training.field.response.refining and logs.abs().min() > 0


def test_from_the_first_step_on_if_asked(scene):
    training = trainer(scene, configuration(response__refine_after=0))
    training.step()
    assert training.field.response.log_densities.abs().max() > 0


def test_weight_pulls_to_the_start_curve(scene):
    sizes = []
    for weight in (0.0, 10.0):
        training = trainer(scene, configuration(response__refine_after=0, response__refine_weight=weight))
        for _ in range(30):
            training.step()
        sizes.append(float(training.field.response.penalty().detach()))
    assert sizes[1] < 0.5 * sizes[0]


def test_rate_is_the_configs(scene):
    for rate in (0.001, 0.01):
        training = trainer(scene, configuration(response__refine_after=0, optimizer__refinement=rate))
        training.step()
        assert float(training.field.response.log_densities.detach().abs().max()) == pytest.approx(rate, rel=1e-3)


def test_run_shows_the_corrected_curve(scene, tmp_path):
    run = train(scene, tmp_path / "run", configuration(), device="cpu", quiet=True)
    loaded = load_run(tmp_path / "run")
    assert isinstance(loaded.response, RefinedResponse) and loaded.response.name == "srgb refined"
    assert loaded.response.log_densities.abs().max() > 0
    codes = np.arange(256) / 255
    np.testing.assert_array_equal(loaded.response.decode(codes), run.response.decode(codes))
    assert np.abs(loaded.response.decode(codes) - loaded.response.start.decode(codes)).max() > 1e-4
    camera = scene.test_views[0].camera
    assert torch.equal(loaded.render_ldr(camera), run.render_ldr(camera))


def test_state_continues_exactly(scene):
    config = configuration()
    whole = trainer(scene, config)
    for _ in range(30):
        whole.step()
    tensors, values = whole.state()
    tensors = {name: value.clone() for name, value in tensors.items()}
    resumed = trainer(scene, config)
    with torch.no_grad():
        for name, value in whole.field.gaussians.tensors().items():
            getattr(resumed.field.gaussians, name).copy_(value)
        resumed.field.response.load_state_dict({"log_densities": tensors["response.log_densities"]})
    resumed.load_state(tensors, values)
    for training in (whole, resumed):
        for _ in range(5):
            training.step()
    assert torch.equal(whole.field.response.log_densities, resumed.field.response.log_densities)


@pytest.mark.parametrize(
    ("clash", "message"),
    [
        ({"response__form": "mlp"}, "response.form"),
        ({"model__radiance": "display"}, "model.radiance"),
        ({"fusion__enabled": True}, "fusion.enabled"),
    ],
)
def test_what_leaves_no_room_for_it(clash, message):
    with pytest.raises(InputError, match=message):
        configuration(**clash)
