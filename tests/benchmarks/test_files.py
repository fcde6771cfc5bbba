"""The figures of exported files, on a run and on Gaussians whose places are known."""

from types import SimpleNamespace

import numpy as np
import pytest

import sehdr_warp as sw
from benchmarks import files
from sehdr_warp.output.world_transform import WorldTransform

from ..output.helpers import Entry, camera
from ..output.test_splat_edits import splats


def test_files_of_a_run_agree_with_it(embedded_run, tmp_path, monkeypatch):
    pytest.importorskip("pxr")
    pytest.importorskip("skimage")
    monkeypatch.setattr(files, "SUFFIXES", (".usdc", ".ply"))
    rows = files.rows_of(sw.load_run(embedded_run), tmp_path, "0,0,1")
    assert [row["file"] for row in rows] == [".usdc", ".ply", ".html"]
    assert all(row["psnr"] > 30 and row["by"] == "truth" and 0 <= row["off"] <= 180 for row in rows[:2])


def test_a_stray_shows_in_the_frame():
    cameras = tuple(Entry(str(i), "train", camera(position=(i - 1, 0, -6))) for i in range(3))
    run, same = SimpleNamespace(cameras=cameras), WorldTransform.identity()
    means = np.random.default_rng(0).uniform(-1, 1, (3000, 3))
    near = files.spread(splats(means, np.full(3000, 0.5)), run, same)
    assert near["frame"] == pytest.approx(1, abs=0.05) and near["farthest"] < 2
    means[7] = (0, 0, 100)
    far = files.spread(splats(means, np.full(3000, 0.5)), run, same)
    assert far["frame"] > 20 and far["farthest"] == pytest.approx(106 / 6, rel=0.1)
