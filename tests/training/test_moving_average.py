"""The moving average that a training ends with."""

import pytest
import torch

from sehdr_warp.runs.checkpoint import Checkpoint
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.training.moving_average import WINDOWS, MovingAverage
from sehdr_warp.training.train import create_trainer, train

from .toy import QUICK, load_unscaled

AVERAGED = QUICK | {"schedule.iterations": 40, "schedule.ema_window": 4500, "densification.refine_stop_iter": 20}


class Moving:
    """Gaussians of one number, which is the iteration."""

    def __init__(self):
        self.value = torch.zeros(3)

    def tensors(self):
        return {"means": self.value}


@pytest.mark.parametrize("average", [0, 100, 1000])
def test_the_mean_is_as_old_as_its_span(average):
    iterations = 6000
    config = load_config("default", {"schedule.iterations": iterations, "schedule.ema_window": 5 * average})
    moving_average, gaussians = MovingAverage(config, 500), Moving()
    begin = max(iterations - WINDOWS * average, 500) + average // 10
    for iteration in range(1, iterations + 1):
        gaussians.value.fill_(iteration)
        moving_average.update(iteration, 1, gaussians)
        if iteration < iterations:
            assert (gaussians.value == iteration).all()
            assert bool(moving_average.means) == (average > 0 and iteration >= begin)
    age = iterations - float(gaussians.value[0])
    assert age == (0 if not average else pytest.approx(0.9 * average, rel=0.1)) and not moving_average.means


@pytest.mark.parametrize(
    ("iterations", "last_change", "batch", "samples"),
    [
        (6000, 5950, 1, [5960, 5970, 5980, 5990, 6000]),
        (6000, 5955, 1, [5960, 5970, 5980, 5990, 6000]),
        (5999, 5950, 1, [5960, 5970, 5980, 5990, 5999]),
        (6000, 5946, 4, [5952, 5960, 5972, 5980, 5992, 6000]),
        (6000, 5950, 4, [5960, 5972, 5980, 5992, 6000]),
    ],
)
def test_fewer_samples_than_the_window_weigh_alike(iterations, last_change, batch, samples):
    """The window is 100 iterations, with a sample every 10."""
    config = load_config("default", {"schedule.iterations": iterations, "schedule.ema_window": 500})
    moving_average, gaussians = MovingAverage(config, last_change), Moving()
    # As from a training that was stopped and goes on with more iterations.
    moving_average.means = {"means": torch.full((3,), 1e6)}
    for iteration in range(batch, iterations + 1, batch):
        gaussians.value.fill_(iteration)
        moving_average.update(iteration, batch, gaussians)
    assert float(gaussians.value[0]) == pytest.approx(sum(samples) / len(samples), abs=0.01)


def test_means_begin_when_the_count_stays():
    config = load_config("default", {"schedule.iterations": 1000, "schedule.ema_window": 15_000})
    assert MovingAverage(config, 500).first == 500


def test_a_training_that_stops_in_between_ends_in_the_same_bits(scene, tmp_path):
    config = load_unscaled("default", AVERAGED)
    whole = train(scene, tmp_path / "whole", config, device="cpu")
    training = create_trainer(scene, tmp_path / "parts", config, device="cpu")
    for step in training:
        if step.iteration == 30:
            training.stop()
    stopped = RunFolder(tmp_path / "parts").newest_checkpoint()
    assert isinstance(stopped, Checkpoint) and any(name.startswith("average.") for name in stopped.tensors)
    resumed = train(scene, tmp_path / "parts", device="cpu", resume=True)
    last = load_unscaled("default", AVERAGED | {"schedule.ema_window": 0})
    plain = train(scene, tmp_path / "plain", last, device="cpu")
    for name, values in whole.field.gaussians.tensors().items():
        assert torch.equal(values, resumed.field.gaussians.tensors()[name]), name
    differs = [
        not torch.equal(a, b) for a, b in zip(whole.field.gaussians.parameters(), plain.field.gaussians.parameters())
    ]
    assert all(differs)
