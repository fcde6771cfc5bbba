"""Merging: which Gaussians of a trained block go into the merged run."""

import logging

import numpy as np
import pytest
import torch

from sehdr_warp.blocks.job import folder_of
from sehdr_warp.blocks.merge import merge_blocks
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_writer import RunWriter, write_confidence


@pytest.mark.parametrize(("margins", "fewer"), [(0.5, 0), (40, 1)])
def test_a_gaussian_that_reaches_far_into_another_block_is_left_out(two_blocks, margins, fewer):
    """Its center is in its core, far from the border."""
    out, plan = two_blocks(20)
    merge_blocks(out, plan, torch.device("cpu"))
    before = load_run(out)
    places = before.field.normalization.scene_points(before.field.gaussians.means.detach().numpy())
    far = places[np.where(plan.division.block_of(places) == 1, plan.division.border_distance(places), 0).argmax()]

    folder = RunWriter(folder_of(out, plan, 1))
    run, checkpoint = load_run(folder.path), folder.newest_checkpoint()
    assert checkpoint is not None
    own = run.field.normalization.scene_points(run.field.gaussians.means.detach().numpy())
    row = np.linalg.norm(own - far, axis=1).argmin()
    changed = {name: tensor.clone() for name, tensor in checkpoint.tensors.items()}
    changed["gaussians.log_scales"][row] = np.log(margins * plan.division.margins.max() / run.field.normalization.unit)
    evidence = folder.read_evidence(checkpoint)
    folder.lock()
    folder.write_checkpoint(changed, checkpoint.values | {"iteration": checkpoint.values["iteration"] + 1}, keep=9)
    write_confidence(folder, evidence, folder.checkpoint_hash)
    try:
        merge_blocks(out, plan, torch.device("cpu"))
        assert load_run(out).gaussian_count == before.gaussian_count - fewer
    finally:
        folder.write_checkpoint(checkpoint.tensors, checkpoint.values, keep=1)
        write_confidence(folder, evidence, folder.checkpoint_hash)
        folder.unlock()


def test_a_cpu_leaves_the_borders_of_blocks_from_gpus_and_says_so(two_blocks, caplog):
    """Refining would take hours where a login node without a GPU merges."""
    out, plan = two_blocks(20)
    folder = RunWriter(folder_of(out, plan, 0))
    summary = folder.read_summary()
    folder.write_summary(summary | {"peak_gpu_memory_bytes": 10**9})
    try:
        with caplog.at_level(logging.WARNING):
            merge_blocks(out, plan, torch.device("cpu"))
    finally:
        folder.write_summary(summary)
    assert "borders are not refined" in caplog.text and "--resume" in caplog.text
    assert load_run(out).summary()["borders_refined"] is False
    merge_blocks(out, plan, torch.device("cpu"))
    assert load_run(out).summary()["borders_refined"] is True
