"""A pack of noise with a lamp, as small as photos are made of."""

import numpy as np
import pytest

from priors.pack import curves
from priors.panoramas import Pack


@pytest.fixture
def pack(tmp_path):
    rng = np.random.default_rng(0)
    panoramas = np.float32(rng.lognormal(0, 1.5, (2, 32, 64, 3)))
    panoramas[:, 8:11, 20:24] = 400.0
    rooms = np.float32(rng.lognormal(0, 1, (3, 2, 40, 40, 3)))
    return Pack(panoramas, np.array([False, True]), ["a", "b"], rooms, curves(tmp_path / "none.mat"))
