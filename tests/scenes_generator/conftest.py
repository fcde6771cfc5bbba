"""Sets of truth without a renderer: flat pictures seen by real cameras."""

import numpy as np
import pytest

from scenes.generator.recipes import Grid, make_cameras, split_of
from scenes.generator.truth_set import write_truth_tables
from sehdr_warp.synth.expose import RadianceView, truth_path, write_radiance

VIEWS = 6


def write_truth(folder, size=32, scale=1.0, peak=None):
    """Six views, radiance over four decades; one pixel of each is `peak`. Returns (views, times)."""
    rng = np.random.default_rng(3)
    cameras = make_cameras(Grid((0.0, -3.0, 1.0), (0.0, 0.0, 1.0), 0.8, 0.4), size, size)[:VIEWS]
    y, x = np.mgrid[0:size, 0:size] / size
    views, counts = [], {"train": 0, "test": 0}
    for index, camera in enumerate(cameras):
        ramp = 10 ** (4 * x - 2)[..., None] * np.stack([1 + 0 * y, 0.5 + y, 1.5 - y], -1)
        radiance = (scale * ramp * rng.uniform(0.9, 1.1, (size, size, 1))).astype(np.float32)
        if peak is not None:
            radiance[3, 5] = peak
        split = split_of(index)
        write_radiance(truth_path(folder, split, counts[split]), radiance, pixel="float")
        counts[split] += 1
        views.append(RadianceView(f"r_{index}", camera, radiance, split))
    times = write_truth_tables(folder, views, {"scene": "flat"})
    return views, times


@pytest.fixture
def truth(tmp_path):
    folder = tmp_path / "truth"
    views, times = write_truth(folder)
    return folder, views, times
