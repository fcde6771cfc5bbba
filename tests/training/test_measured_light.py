"""Light that a few darker photos measure, though most photos clip it and have estimates of it."""

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.runs.field import field_from_checkpoint
from sehdr_warp.scene import Camera, View, codes_of
from sehdr_warp.scene.wide_camera import solid_angles
from sehdr_warp.training.measured_light import DEVIATION, are_measured, measured_estimates
from sehdr_warp.training.trainer import Trainer
from sehdr_warp.training.training_state import load_state, state_of
from tests.model.test_lights import field, panel, views

from .toy import load_unscaled, make_trainer
from .wall_and_lamp import wall_and_lamp

ESTIMATE = 3.0


def photos(truth, times, shifts):
    """Photos of a scene, of which some are shifted so that they show its left part alone."""
    result = []
    for (camera, _), time, shift in zip(views(), times, shifts, strict=True):
        camera = camera.resized(64, 48)
        camera = type(camera)(64, 48, camera.fx, camera.fy, camera.cx + shift, camera.cy, camera.world_to_camera)
        codes = codes_of(truth.response.encode(truth.render(camera).hdr * time).clamp(0, 1).numpy(), 8)
        result.append(View(f"v{len(result)}", codes, camera, time, "train"))
    return result


def test_estimates_are_replaced_where_a_darker_photo_measures_the_light():
    """The scene has a third of the light. The dark photo shows one of two panels, the other keeps its estimates."""
    places = np.concatenate([panel(0.5, 0.5, at=(-0.7, 0, 4)), panel(0.5, 0.5, at=(0.7, 0, 4))])
    truth, scene = field(places, (24.0,) * 3, 0.03), field(places, (8.0,) * 3, 0.03)
    shots = photos(truth, (1, 1, 1 / 32, 1, 1, 1), (0, 0, 28, 0, 0, 0))
    estimates = [torch.tensor([ESTIMATE] * 3 + [1.0] * 3).half().expand(48, 64, 6) for _ in shots]
    assert are_measured(shots) and not are_measured(shots[:2])
    results = measured_estimates(scene, shots, estimates, 0)
    assert torch.equal(results[2], estimates[2])
    for view, result in zip(shots[:2], results, strict=False):
        white = torch.from_numpy((view.codes == 255).all(2))
        left = white & (torch.arange(64) < 32)
        right = white & ~left
        assert left.sum() > 20 and right.sum() > 20
        assert (result[right][:, 0] == ESTIMATE).float().mean() > 0.9
        is_new = result[left][:, 3] == torch.tensor(1 / DEVIATION).half()
        assert is_new.float().mean() > 0.9
        assert result[left][is_new][:, 0].median() == pytest.approx(math.log(24), abs=0.1)
        assert torch.equal(result[~white], estimates[0][~white])


@pytest.mark.parametrize(("stated", "stays"), [(24.0, True), (30.0, True), (4.0, False)])
def test_light_that_a_gain_map_states_stays_unless_a_darker_photo_contradicts(stated, stays):
    """A gain map that ends at 4 times white states less than a lamp's light."""
    places = panel(0.5, 0.5)
    shots = photos(field(places, (24.0,) * 3, 0.03), (1, 1, 1 / 32, 1, 1, 1), (0,) * 6)
    estimates = [torch.tensor([math.log(stated)] * 3 + [1 / 0.05] * 3).half().expand(48, 64, 6) for _ in shots]
    result = measured_estimates(field(places, (8.0,) * 3, 0.03), shots, estimates, 0)[0]
    inner = torch.from_numpy((shots[0].codes == 255).all(2))
    expected = math.log(stated if stays else 24)
    assert result[inner][:, 0].median() == pytest.approx(expected, abs=0.02)
    assert result[inner][:, 3].median() == pytest.approx(20 if stays else 1 / DEVIATION, rel=1e-3)


@pytest.mark.parametrize(("time", "depth", "code"), [(2.0**-15, 8, 0), (2.0**-13, 16, 2 * 257)])
def test_a_photo_so_dark_that_the_light_has_few_codes_does_not_measure_it(time, depth, code):
    """Also if it has 16 bits because it was averaged, where errors of 8 bits remain."""
    places = panel(0.5, 0.5)
    shots = photos(field(places, (4.0,) * 3, 0.03), (1, 1, time, 1, 1, 1), (0,) * 6)
    if depth == 16:
        shots[2] = replace(shots[2], codes=shots[2].codes.astype(np.uint16) * 257)
    assert shots[2].codes.max() == code
    estimates = [torch.tensor([ESTIMATE] * 3 + [1.0] * 3).half().expand(48, 64, 6) for _ in shots]
    results = measured_estimates(field(places, (8.0,) * 3, 0.03), shots, estimates, 0)
    assert all(torch.equal(*pair) for pair in zip(results, estimates, strict=True))


def test_a_dark_panorama_measures_a_light_overhead():
    """Its pixels there count by their solid angle, which the masks of panoramas hold, in every comparison."""
    places = panel(0.9, 0.9, 0.05, at=(0, 0.3, -4))[:, [0, 2, 1]]
    truth, scene = field(places, (24.0,) * 3, 0.06), field(places, (8.0,) * 3, 0.06)
    shots = []
    for x, time in ((-0.3, 1), (0.0, 1), (0.3, 1 / 32)):
        pose = np.eye(4)
        pose[0, 3] = -x
        camera = Camera(128, 64, 64 / np.pi, 64 / np.pi, 64, 32, pose, "equirectangular")
        codes = codes_of(truth.response.encode(truth.render(camera).hdr * time).clamp(0, 1).numpy(), 8)
        shots.append(View(f"v{len(shots)}", codes, camera, time, "train", mask=solid_angles(camera)))
    estimates = [torch.tensor([ESTIMATE] * 3 + [1.0] * 3).half().expand(64, 128, 6) for _ in shots]
    result = measured_estimates(scene, shots, estimates, 0)[0]
    is_new = result[..., 0] != ESTIMATE
    assert is_new.sum() > 0.6 * (shots[0].codes == 255).all(2).sum() > 200
    assert result[is_new][:, 0].median() == pytest.approx(math.log(24), abs=0.2)
    angles = solid_angles(shots[0].camera)
    expected = torch.from_numpy(np.sqrt(angles / angles.mean()))[is_new] / DEVIATION
    torch.testing.assert_close(result[is_new][:, 3].float(), expected, rtol=2e-3, atol=0)


def test_a_training_continues_with_the_estimates_that_it_replaced():
    """Bit for bit, from a state behind the first update, and over the next one."""
    scene = wall_and_lamp((1.0, 1.0, 1.0, 1 / 2048), "srgb")
    config = load_unscaled("default", {"schedule.iterations": 40, "response.name": "srgb"})
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        whole = make_trainer(scene, config)
        before = deepcopy(whole.data_manager.estimates)
        for _ in range(15):
            whole.step()
        state = deepcopy(state_of(whole))
        assert any(not torch.equal(*pair) for pair in zip(before, whole.data_manager.estimates, strict=True))
        info = {"response": whole.field.response.to_dict(), "base_time": whole.field.base_time}
        info["normalization"] = whole.field.normalization.to_dict()
        resumed = Trainer(scene, config, field_from_checkpoint(state, config, info))
        load_state(resumed, state)
        for trainer in (whole, resumed):
            for _ in range(10):
                trainer.step()
    finally:
        torch.set_num_threads(threads)
    again = state_of(resumed).tensors
    assert state_of(whole).tensors.keys() == again.keys()
    for name, value in state_of(whole).tensors.items():
        assert torch.equal(value, again[name]), name
