"""What a training does without: Gaussians that add nothing, degrees that gain nothing, steps at the end, the unseen."""

from dataclasses import replace

import pytest
import torch

from sehdr_warp.field.radiance_field import CameraTensors
from sehdr_warp.training.config_files import load_config
from sehdr_warp.training.early_stop import EarlyStop
from sehdr_warp.training.initialization import choose_response, make_field
from sehdr_warp.training.thinning import contributing, degree_gain
from sehdr_warp.training.trainer import Trainer

from .recorded import check_recorded_like_launched
from .toy import orbit_camera, toy_field, toy_scene

OPTIONS = {
    "response.name": "srgb",
    "schedule.iterations": 40,
    "schedule.stated_for": 40,
    "schedule.harmonics_every": 10,
    "model.harmonics_degree": 2,
    "densification.strategy": "none",
}


def trainer_of(scene, device="cpu", **changes):
    config = load_config("default", OPTIONS | {name.replace("__", "."): value for name, value in changes.items()})
    return Trainer(scene, config, make_field(scene, config, choose_response(scene, config), device))


def run(trainer, steps):
    for _ in range(steps):
        trainer.step()
    return trainer


def test_what_no_photo_shows_is_taken_away_with_its_moments(scene, device):
    trainer = run(trainer_of(scene, device), 3)
    gaussians = trainer.field.gaussians
    hidden = torch.zeros(gaussians.count, dtype=torch.bool, device=device)
    hidden[[1, 5]] = True
    with torch.no_grad():
        gaussians.means[1] = torch.tensor([0.0, 0.0, 500.0])  # out of every photo
        gaussians.opacity_logits[5] = -20.0  # in view, transparent
    views = trainer._training_views()
    kept = contributing(trainer.field, views, 1e-3)
    assert (kept == ~hidden).all()
    moments = trainer.optimizer.state[gaussians.means]["exp_avg"].clone()
    trainer.config = load_config("default", OPTIONS | {"densification.contribution": 1e-3})
    trainer._thin(views)
    assert gaussians.count == int(kept.sum())
    assert torch.equal(trainer.optimizer.state[gaussians.means]["exp_avg"], moments[kept])
    run(trainer, 2)


def test_thinning_happens_at_its_iterations_and_leaves_some(scene):
    changes = {"densification__contribution": 50.0, "densification__contribution_at": [20]}
    trainer = run(trainer_of(scene, **changes), 19)
    before = trainer.field.gaussians.count
    trainer.step()
    assert 4 <= trainer.field.gaussians.count < before


def test_densification_forgets_what_was_thinned(scene):
    changes = {"densification__strategy": "gradient", "densification__contribution": 5.0}
    trainer = run(trainer_of(scene, **changes, densification__contribution_at=[7]), 7)
    assert len(trainer.densification.gradient_sum) == trainer.field.gaussians.count < len(scene.points)
    run(trainer, 3)


@pytest.mark.parametrize("visible_only", [False, True])
def test_degrees_on_demand_are_the_same_training(scene, visible_only):
    trainers = [
        run(trainer_of(scene, schedule__harmonics_on_demand=demand, optimizer__visible_only=visible_only), step)
        for demand, step in ((False, 25), (True, 25))
    ]
    assert trainers[1].field.gaussians.degree == 2
    for name, value in trainers[0].field.gaussians.tensors().items():
        # To rounding: torch's Adam takes the last numbers of a tensor of another length in another way.
        torch.testing.assert_close(trainers[1].field.gaussians.tensors()[name], value, rtol=1e-5, atol=1e-6, msg=name)
    early = run(trainer_of(scene, schedule__harmonics_on_demand=True), 9)
    assert early.field.gaussians.harmonics_rest.shape[1] == 0


def test_a_degree_that_gains_nothing_is_taken_out_for_good(scene):
    trainer = run(trainer_of(scene, schedule__harmonics_gain=10.0), 19)
    assert trainer.degree == trainer.field.gaussians.degree - 1 == 1
    run(trainer, 1)
    assert trainer.degree == trainer.field.gaussians.degree == 0
    tensors, values = run(trainer, 15).state()
    assert trainer.degree == 0
    resumed = trainer_of(scene, schedule__harmonics_gain=10.0)
    resumed.field.gaussians.set_degree(0)
    resumed = Trainer(scene, resumed.config, resumed.field)
    resumed.load_state(tensors, values)
    assert resumed.degree == 0


def test_the_gain_of_a_degree_is_positive_where_it_helps(scene):
    trainer = run(trainer_of(scene), 20)
    field, views, loss = trainer.field, trainer._training_views(), trainer.config.loss
    gain = degree_gain(field, views, 1, loss)
    assert gain > 0
    # What no degree changes is no part of the comparison.
    assert degree_gain(field, views, 1, replace(loss, opacity_weight=1.0, scale_weight=1.0)) == gain
    with torch.no_grad():
        field.gaussians.harmonics_rest.zero_()
    assert degree_gain(field, views, 1, loss) == 0


def test_only_what_is_in_the_photo_moves(scene, device):
    trainer = run(trainer_of(scene, device, optimizer__visible_only=True), 5)
    gaussians = trainer.field.gaussians
    with torch.no_grad():
        gaussians.means[0] = torch.tensor([0.0, 0.0, 500.0])
    before, moments = gaussians.tensors(), dict(trainer.optimizer.state[gaussians.means])
    before = {name: value.clone() for name, value in before.items()}
    first = moments["exp_avg"].clone()
    trainer.step()
    for name, value in gaussians.tensors().items():
        assert torch.equal(value[0], before[name][0]), name
    assert torch.equal(trainer.optimizer.state[gaussians.means]["exp_avg"][0], first[0])
    assert not torch.equal(gaussians.means[1:], before["means"][1:])


def test_where_all_is_visible_the_step_is_adams(scene):
    plain, sparse = (run(trainer_of(scene, optimizer__visible_only=only), 1) for only in (False, True))
    seen = toy_field().gaussians.count
    for name, value in plain.field.gaussians.tensors().items():
        torch.testing.assert_close(sparse.field.gaussians.tensors()[name], value, rtol=1e-5, atol=1e-6, msg=name)
    assert seen == len(scene.points)


def test_early_stop_waits_for_patience_and_for_the_schedule():
    config = load_config(
        "default", OPTIONS | {"schedule.early_stop": 2, "schedule.early_stop_every": 5, "schedule.early_stop_gain": 0.1}
    )
    rule = EarlyStop(config)
    figures = {5: 20.0, 30: 20.0, 35: 20.05, 40: 20.2, 45: 20.25, 50: 20.2}
    for iteration, figure in figures.items():
        assert rule.is_due(iteration) and rule.stopped_at is None
        rule.look(iteration, figure)
    # 30 is before all degrees had their time; 35 is the first look, 40 a gain, 45 and 50 none.
    assert rule.stopped_at == 50
    again = EarlyStop(config)
    again.load_state(rule.state())
    assert again.state() == rule.state()


@pytest.mark.parametrize("on", ["held-in", "held-out"])
def test_a_training_that_gains_nothing_stops(scene, on, tmp_path):
    from sehdr_warp.training.train import train

    changes = {
        "schedule.early_stop": 1,
        "schedule.early_stop_every": 2,
        "schedule.early_stop_gain": 10.0,
        "schedule.early_stop_on": on,
        "model.harmonics_degree": 0,
    }
    config = load_config("default", OPTIONS | changes)
    run = train(scene, tmp_path / "run", config, device="cpu", quiet=True)
    summary = run.summary()
    assert summary["finished"] and summary["stopped_at"] == run.iterations == 14
    assert run.metrics()[-1]["iteration"] == 14
    # A resumed training is at its end.
    assert train(scene, tmp_path / "run", config, device="cpu", quiet=True, resume=True).iterations == 14


def test_contributions_are_sums_of_blend_weights():
    field, camera = toy_field(), orbit_camera(0.3)
    ones = torch.ones(camera.height, camera.width, 3)
    sums = field.weighted_sums(CameraTensors.of(camera, "cpu"), ones)[:, 0]
    assert float(sums.sum()) == pytest.approx(float(field.render(camera).alpha.sum()), rel=1e-4)


@pytest.mark.parametrize(
    "preset,channels",
    [
        ("default", 3),
        ("paper", 9),  # photo, fused and base: the linear loss compares the last two
        ("paper-truth", 6),  # photo and base: truth stands for the fused colours
        ("hdr-gs-truth", 6),
        ("truth", 3),
    ],
)
def test_colours_without_a_loss_are_not_rendered(scene, preset, channels, monkeypatch):
    from sehdr_warp.field import radiance_field

    widths, rasterize = [], radiance_field.rasterize

    def counted(*arguments, **options):
        widths.append(arguments[4].shape[1])
        return rasterize(*arguments, **options)

    monkeypatch.setattr(radiance_field, "rasterize", counted)
    config = load_config(
        preset, {"response.name": "srgb", "densification.strategy": "none", "model.harmonics_degree": 0}
    )
    run(Trainer(scene, config, make_field(scene, config, choose_response(scene, config), "cpu")), 1)
    assert widths == [channels]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")
def test_recorded_steps_leave_out_the_same():
    changes = {
        "schedule.iterations": 400,
        "schedule.stated_for": 400,
        "schedule.harmonics_every": 100,
        "schedule.harmonics_on_demand": True,
        "schedule.harmonics_gain": 1e-6,
        "schedule.early_stop": 100,
        "schedule.early_stop_every": 50,
        "densification.contribution": 0.05,
        "densification.contribution_at": [150, 250],
        "optimizer.visible_only": True,
    }
    trainers = check_recorded_like_launched(toy_scene(), load_config("default", OPTIONS | changes), 300)
    assert all(trainer._early_stop.best > 0 for trainer in trainers)
