"""Refining borders: what is trained, what stays, and what it gains."""

import numpy as np
import torch

from sehdr_warp.blocks.job import folder_of
from sehdr_warp.blocks.refine import BAND, refine_borders
from sehdr_warp.blocks.seams import measure_seams
from sehdr_warp.model.gaussians import PARAMETER_NAMES, Gaussians
from sehdr_warp.runs.config_files import override_config
from sehdr_warp.runs.open import load_scene_and_log_notes
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder


def merged_rows(out, plan):
    """Return tensors [N, ...] of the Gaussians in the cores, and their blocks [N]."""
    parts, owners = [], []
    for index in (0, 1):
        run = load_run(folder_of(out, plan, index))
        gaussians = run.field.gaussians.tensors()
        places = run.field.normalization.scene_points(gaussians["means"].numpy())
        inside = torch.from_numpy(plan.division.block_of(places) == index)
        rows = {name: values[inside].clone() for name, values in gaussians.items()}
        rows["means"] = torch.from_numpy(plan.normalization.points(places[inside.numpy()]).astype(np.float32))
        rows["log_scales"] += np.log(run.field.normalization.unit / plan.normalization.unit)
        parts.append(rows)
        owners.append(torch.full((int(inside.sum()),), index))
    return {name: torch.cat([rows[name] for rows in parts]) for name in PARAMETER_NAMES}, torch.cat(owners)


def test_only_gaussians_near_borders_change_and_the_border_gets_better(two_blocks):
    out, plan = two_blocks(150)
    before, blocks = merged_rows(out, plan)
    after = {name: values.clone() for name, values in before.items()}
    refine_borders(after, blocks, out, plan, torch.device("cpu"))

    places = plan.normalization.scene_points(before["means"].numpy())
    far = plan.division.border_distance(places) > BAND * plan.division.margins.max()
    changed = (after["harmonics_dc"] != before["harmonics_dc"]).flatten(1).any(1).numpy()
    assert far.any() and not changed[far].any()
    assert changed[~far].mean() > 0.5

    run = load_run(folder_of(out, plan, 0))
    run.field.normalization = plan.normalization
    names = [entry for entry in plan.exposure_times if int(entry[-5:]) % 8 == 4]
    views = load_scene_and_log_notes(plan.data | {"views": names}, response="srgb").views
    errors = []
    for tensors in (before, after):
        run.field.gaussians = Gaussians(**tensors)
        errors.append(measure_seams(run, views, plan.division).border)
    assert errors[1] > errors[0] + 0.2


def test_no_gaussians_are_added_near_borders_even_if_the_blocks_were_densified_to_their_end(two_blocks, monkeypatch):
    out, plan = two_blocks(150)
    read_config, late = RunFolder.read_config, {"densification.refine_stop_iter": 30_000, "mcmc.cap_density": 1000.0}
    monkeypatch.setattr(RunFolder, "read_config", lambda folder: override_config(read_config(folder), late))
    before, blocks = merged_rows(out, plan)
    after = {name: values.clone() for name, values in before.items()}
    refine_borders(after, blocks, out, plan, torch.device("cpu"))
    places = plan.normalization.scene_points(before["means"].numpy())
    far = plan.division.border_distance(places) > BAND * plan.division.margins.max()
    assert far.any() and all(torch.equal(after[name][far], before[name][far]) for name in before)


def test_the_rows_around_trained_gaussians_are_rendered_and_stay(two_blocks):
    """They hide what is behind them, and Adam has no moments for them."""
    out, plan = two_blocks(150)
    tensors, blocks = merged_rows(out, plan)
    gaussians = Gaussians(**{name: values[blocks == 0] for name, values in tensors.items()})
    gaussians.surround({name: values[blocks == 1] for name, values in tensors.items()})
    count = int((blocks == 0).sum())
    assert gaussians.count == count and gaussians.row_count == len(blocks)
    with gaussians.all_rows(_NoOptimizer()):
        assert torch.equal(gaussians.means, tensors["means"])
    assert len(gaussians.tensors()["means"]) == count


class _NoOptimizer:
    """An optimizer without parameters."""

    param_groups, state = [], {}
