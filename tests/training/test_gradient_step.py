"""Gradient steps: which Gaussians they leave out, in which order they show them, and how opaque these become."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sehdr_warp.model.gaussians import Gaussians, moments_of
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera, Scene, View, codes_of
from sehdr_warp.training.gradient_step import Dropout, OrderAxis, opaque_steps, transmittance_weight
from sehdr_warp.training.strategies.base import Schedule
from sehdr_warp.training.trainer import Trainer

from .toy import EXPOSURE_TIME, VARIANTS, make_trainer, quick

ROWS = 100_000


def test_a_growing_share_is_left_out_and_the_mean_stays(device):
    dropout = Dropout(0.4, 3, 1000, torch.device(device))
    for iteration, share in ((1, 0.0004), (500, 0.2), (1000, 0.4)):
        dropout.draw(iteration, ROWS)
        assert float((dropout.factors == 0).float().mean()) == pytest.approx(share, abs=0.005)
        assert float(dropout.factors.mean()) == pytest.approx(1, abs=0.01)
    none = Dropout(0.0, 0, 1000, torch.device(device))
    none.draw(10, ROWS)
    assert none.factors is None


def test_draws_depend_on_seed_and_iteration_alone_and_keep_their_memory(device):
    def factors(seed: int, *iterations: int) -> torch.Tensor:
        dropout = Dropout(0.4, seed, 1000, torch.device(device))
        addresses = set()
        for iteration in iterations:
            dropout.draw(iteration, ROWS)
            addresses.add(dropout.factors.data_ptr())
        assert len(addresses) == 1
        return dropout.factors

    assert torch.equal(factors(1, 600, 700), factors(1, 700))
    assert not torch.equal(factors(1, 700), factors(2, 700))
    assert not torch.equal(factors(1, 700), factors(1, 701))


def test_gaussians_that_are_left_out_get_no_gradient(scene):
    shares = []
    for variant in ("default", "dropout"):
        trainer = make_trainer(scene, VARIANTS[variant])
        trainer.iteration = trainer.total - 1  # With dropout, the last step leaves out half of the Gaussians.
        trainer.step()
        squares = moments_of(trainer.optimizer, trainer.field.gaussians.log_scales)["exp_avg_sq"]
        shares.append(float(squares.any(1).float().mean()))
    assert shares[1] == pytest.approx(0.5 * shares[0], abs=0.1)


def test_gaussians_that_are_nearly_opaque_are_left_out_too(scene):
    """Divided by what is left, their opacities are above 1."""
    config = quick(**{"model.dropout": 0.5, "seed": 2**62})
    trainer = make_trainer(scene, config)
    trainer.field.gaussians.opacity_logits.data.fill_(6.0)
    trainer.iteration = trainer.total - 1
    trainer.step()
    assert trainer.loss < 1
    squares = moments_of(trainer.optimizer, trainer.field.gaussians.harmonics_dc)["exp_avg_sq"]
    assert 0 < float(squares.any(1).float().mean()) < 0.6


def test_an_axis_depends_on_seed_and_iteration_alone_and_keeps_its_memory(device):
    def axis(seed: int, *iterations: int) -> list[float]:
        order = OrderAxis(30.0, seed, torch.device(device))
        addresses = set()
        for iteration in iterations:
            order.draw(iteration)
            addresses.add(order.axis.data_ptr())
        assert len(addresses) == 1 and float(order.axis[2]) == 1 and float(order.axis[:2].abs().max()) <= 0.5774
        return order.axis.tolist()

    assert axis(1, 600, 700) == axis(1, 700)
    assert axis(0, 1) == pytest.approx([0.40118, 0.30458, 1.0], abs=1e-5), "not the same on all devices"
    slopes = torch.tensor([axis(seed, n)[:2] for seed in (3, 2**62) for n in range(200, 400, 2)])
    turned = slopes.any(1)
    assert 70 < int(turned.sum()) < 130 and len(slopes[turned].unique(dim=0)) == int(turned.sum())
    assert float(slopes.abs().max()) > 0.5 and float(slopes.mean(0).abs().max()) < 0.08


@pytest.mark.parametrize("angle", [0.0, 25.0])
def test_a_turned_camera_shows_what_photos_from_its_place_show(angle):
    """A wall hides a light right behind it, which is in front of the wall for a camera that is turned aside."""
    means, logarithms = torch.tensor([[0.0, 0.0, 4.0], [1.5, 0.0, 4.02]]), torch.tensor([[-1.0] * 3, [2.0] * 3])
    gaussians = Gaussians.from_points(means, logarithms, 0, opacity=0.999, scale=1.0)
    gaussians.log_scales.data.fill_(1.5)
    field = RadianceField(gaussians, response_by_name("srgb"), base_time=EXPOSURE_TIME)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 15, degrees=True).as_matrix()
    camera, turned = (Camera(24, 24, 24.0, 24.0, 12.0, 12.0, pose) for pose in (np.eye(4), turn))
    codes = codes_of(field.render_ldr(camera).numpy(), 8)
    views = tuple(View(name, codes, camera, EXPOSURE_TIME, "train") for name in "ab")
    scene = Scene("wall", "transforms", views, means.double().numpy(), np.ones((2, 3), np.float32))
    times = {"densification.refine_start_iter": 1000, "densification.refine_stop_iter": 1001, "schedule.ema_window": 0}
    rates = {"optimizer.means": 1e-9, "optimizer.means_final": 1e-9, "optimizer.harmonics_dc": 0.03}
    trainer = Trainer(scene, quick(length=400, **times, **rates, **{"model.order_angle": angle}), field)
    for _ in range(400):
        trainer.step()
    wall, aside = (float(field.render(each).hdr[12, 12].mean()) for each in (camera, turned))
    assert wall == pytest.approx(1.5, rel=0.3)
    assert aside < 6 * wall if angle else aside > 15 * wall


def wall_scene(field: RadianceField, camera: Camera, *, transparent: bool) -> Scene:
    """Two photos of a field before black."""
    codes = codes_of(field.render_ldr(camera).numpy(), 8)
    views = tuple(View(name, codes, camera, EXPOSURE_TIME, "train") for name in "ab")
    points = field.gaussians.means.detach().double().numpy()
    return Scene("wall", "transforms", views, points, np.ones((1, 3), np.float32), black_background=transparent)


def wall_field(log_scale: float) -> RadianceField:
    """A Gaussian that lets through half of its light."""
    gaussians = Gaussians.from_points(torch.tensor([[0.0, 0.0, 4.0]]), torch.zeros(1, 3), 0, opacity=0.5, scale=1.0)
    gaussians.log_scales.data.fill_(log_scale)
    return RadianceField(gaussians, response_by_name("srgb"), base_time=EXPOSURE_TIME)


NO_REFINEMENT = {"densification.refine_start_iter": 0, "densification.refine_stop_iter": 0, "schedule.ema_window": 0}


@pytest.mark.parametrize(("weight", "transparent"), [(7.0, False), (0.0, False), (7.0, True)])
def test_surfaces_become_opaque(weight, transparent):
    """A wall that lets through half of its light fits photos before black as well as an opaque one."""
    field, camera = wall_field(3.0), Camera(16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))
    scene = wall_scene(field, camera, transparent=transparent)
    photo = scene.views[0].image
    rates = {"optimizer.opacity_logits": 0.3, "optimizer.harmonics_dc": 0.05, "loss.opacity_weight": 0.0}
    config = quick(length=600, **NO_REFINEMENT, **rates, **{"loss.transmittance_weight": weight})
    trainer = Trainer(scene, config, field)
    for _ in range(600):
        trainer.step()
    alpha = field.render(camera).alpha
    assert alpha.min() > 0.9 if weight and not transparent else alpha.max() < 0.65
    assert np.abs(field.render_ldr(camera).numpy() - photo).max() < 0.03


def test_steps_that_make_surfaces_opaque_leave_positions_and_sizes(device):
    """They would grow Gaussians at the borders of photos into what no photo shows."""
    field, camera = wall_field(-1.0), Camera(16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))
    scene = wall_scene(field, camera, transparent=False)
    trainer = Trainer(scene, quick(length=100, **NO_REFINEMENT, **{"loss.transmittance_weight": 1.0}), field.to(device))
    changes = []
    for _ in range(100):
        before = {name: tensor.detach().clone() for name, tensor in field.gaussians.tensors().items()}
        trainer.step()
        after = field.gaussians.tensors()
        changes.append({name for name, tensor in before.items() if not torch.equal(tensor, after[name])})
    shapes = {"means", "log_scales"}  # Rotations of a round Gaussian get no gradient at any time.
    assert all(shapes <= names for names in changes[:49] + changes[54:])
    assert all(not shapes & names and "opacity_logits" in names for names in changes[49:54])


@pytest.mark.parametrize(
    ("stop", "weight", "black", "expected"),
    [
        (600, 0.3, False, range(600, 650)),
        (100, 0.3, False, range(500, 550)),
        (970, 0.3, False, range(970, 1000)),
        (1000, 0.3, False, range(0)),
        (600, 0.0, False, range(0)),
        (600, 0.3, True, range(0)),
    ],
)
def test_surfaces_become_opaque_after_the_last_refinement(stop, weight, black, expected):
    config = quick(length=1000, **{"loss.transmittance_weight": weight})
    assert opaque_steps(config, Schedule(0, stop, 100), black_background=black) == expected


def test_trainings_of_few_steps_have_less_of_the_weight():
    weights = [transmittance_weight(quick(length=length), batch) for length, batch in ((8000, 1), (1000, 1), (8000, 8))]
    assert weights == [1.0, 0.25, 0.25]
