"""A training that runs out of memory ends in one line with the sizes."""

import pytest
import torch

from sehdr_warp.rasterizer.memory import OutOfMemory
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.training.train import train
from sehdr_warp.training.trainer import Trainer

from .toy import toy_scene

CUDA = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB. GPU 0 has a total capacity of 80 GiB")


@pytest.mark.parametrize(
    ("place", "error", "remedy"),
    [
        ("step", CUDA, "3.00 GiB"),
        ("step", MemoryError(), "some memory"),
        ("__init__", RuntimeError("Failed to allocate 1048576 bytes on device 'cuda:0'"), "1.00 MiB"),
    ],
)
def test_the_line_names_gaussians_photo_and_remedy(tmp_path, monkeypatch, place, error, remedy):
    def fails(*arguments, **options):
        raise error

    monkeypatch.setattr(Trainer, place, fails)
    with pytest.raises(OutOfMemory) as caught:
        train(toy_scene(), tmp_path / "run", load_config("fast", {"model.initial_density": 0.0}), device="cpu")
    assert str(caught.value) == (
        f"out of memory on cpu: {remedy} could not be allocated with 60 Gaussians, an image of 32 x 32; "
        "use fewer Gaussians (densification.cap_max) or a smaller image (max_size)"
    )
