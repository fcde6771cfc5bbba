"""The figures of exported files, on a run and on Gaussians whose places are known."""

import pytest

import sehdr_warp as sw
from benchmarks import files


def test_files_of_a_run_agree_with_it(embedded_run, tmp_path, monkeypatch):
    pytest.importorskip("pxr")
    pytest.importorskip("skimage")
    monkeypatch.setattr(files, "SUFFIXES", (".usdc", ".ply"))
    rows = files.rows_of(sw.load_run(embedded_run), tmp_path, "0,0,1")
    assert [row["file"] for row in rows] == [".usdc", ".ply", ".html"]
    assert all(row["psnr"] > 30 and row["by"] == "truth" and 0 <= row["off"] <= 180 for row in rows[:2])
