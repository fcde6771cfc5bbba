"""Training of the prior: the target of several teachers, and the command from a pack to a weights file."""

import numpy as np
import pytest
import torch

from priors import rooms, train
from priors.pack import curves
from priors.panoramas import to_differences, to_rgbe, write_pack
from priors.photos import Photos
from sehdr_warp.prior import load_prior


class Teacher(torch.nn.Module):
    """Say the same mean and deviation of every value."""

    def __init__(self, mean: float, deviation: float):
        super().__init__()
        self.mean, self.deviation = mean, deviation

    def forward(self, pictures):
        ones = torch.ones_like(pictures[:, :3])
        return self.mean * ones, self.deviation * ones


def clipped_photos(truth: float) -> Photos:
    """Two photos of 16 pixels that clip everywhere, at a truth in stops over white."""
    ones = torch.ones(2, 3, 16, 16)
    return Photos(ones, ones, truth * ones)


def test_the_target_of_teachers_is_the_mean_and_the_variance_of_their_mixture():
    target = train.target_of(clipped_photos(5.0), [Teacher(1.0, 0.5), Teacher(3.0, 1.5)])
    assert torch.allclose(target.mean, torch.tensor(2.0))
    # Half of 0.5^2 + 1.5^2, and 1 of the distance between them.
    assert torch.allclose(target.variance, torch.tensor(2.25))
    truth = train.target_of(clipped_photos(5.0), [])
    assert torch.allclose(truth.mean, torch.tensor(5.0)) and not truth.variance.any()


def test_the_loss_is_smallest_at_the_mean_of_the_target(monkeypatch):
    monkeypatch.setattr(train, "ENERGY_WEIGHT", 0.0)
    photos, target = (
        clipped_photos(5.0),
        train.Target(torch.full((2, 3, 16, 16), 2.0), torch.full((2, 3, 16, 16), 2.25)),
    )
    mean = torch.full((2, 3, 16, 16), 2.0, requires_grad=True)
    deviation = torch.full((2, 3, 16, 16), 1.5, requires_grad=True)
    train.pixel_loss(mean, deviation, target, photos).backward()
    assert mean.grad is not None and deviation.grad is not None
    assert mean.grad.abs().max() < 1e-9 and deviation.grad.abs().max() < 1e-9
    wider = torch.full((2, 3, 16, 16), 2.5, requires_grad=True)
    train.pixel_loss(mean.detach(), wider, target, photos).backward()
    assert wider.grad is not None and wider.grad.min() > 0


@pytest.fixture
def own_settings():
    """Restore what the command sets for its process."""
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.usefixtures("own_settings")
def test_the_command_trains_teachers_once_and_the_network_from_them(tmp_path, monkeypatch):
    for module, name, value in (
        (train, "BATCH", 5),
        (train, "AT_ONCE", 1),
        (train, "SCALE_PHOTOS", 5),
        (rooms, "PIXELS", 32),
        (rooms, "SAMPLES", 1),
    ):
        monkeypatch.setattr(module, name, value)
    rng = np.random.default_rng(0)
    panoramas = rng.lognormal(0, 1.5, (2, 32, 64, 3)).astype(np.float32)
    panoramas[:, 8:11, 20:24] = 400.0
    arrays = {"panoramas": to_differences(to_rgbe(panoramas)), "held_out": np.array([False, True])}
    arrays |= {"names": np.array(["a", "b"]), "curves": curves(tmp_path / "none.mat")}
    views = rng.lognormal(0, 1, (3, 2, 40, 40, 3)).astype(np.float32)
    write_pack(tmp_path / "pack.npz", arrays | {"rooms": to_differences(to_rgbe(views))})

    def weights(name: str) -> dict:
        train.main(tmp_path / "pack.npz", tmp_path / name, teachers=1, steps=2, lit_rooms=2, device="cpu")
        return load_prior(path=tmp_path / name).network.state_dict()

    first = weights("a.safetensors")
    teacher = tmp_path / "a_teacher_0.safetensors"
    assert not torch.equal(
        first["middle.first.weight"], load_prior(path=teacher).network.state_dict()["middle.first.weight"]
    )
    written = teacher.stat().st_mtime_ns
    again = weights("a.safetensors")
    assert teacher.stat().st_mtime_ns == written
    assert all(torch.equal(first[name], again[name]) for name in first)
