"""A run with every file that a run may have, and a writer of checkpoints."""

import pytest
import torch

from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_writer import RunWriter
from tests.fuzz.run_readers import make_confidence


@pytest.fixture
def run(tmp_path):
    """A run with every file that a run may have."""
    make_confidence(tmp_path / "run")
    return tmp_path / "run"


def read_all(path):
    run = load_run(path)
    return run.metrics(), run.summary(), run.decisions(), run.clipped_share()


@pytest.fixture
def folder(tmp_path):
    return RunWriter(tmp_path)


def state(iteration):
    tensors = {
        "a.b": torch.arange(6.0).reshape(2, 3) + iteration,
        "step": torch.tensor(3.0),
        "rng": torch.arange(4, dtype=torch.uint8),
    }
    return tensors, {"iteration": iteration, "order": [2, 0], "seconds": 1.25}
