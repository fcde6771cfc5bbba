"""Regions of photos that a scene does not explain: a lamp that is missing, and none in a complete scene."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.model.confidence import gather_evidence
from sehdr_warp.model.residual_regions import compare_photos
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.training.train import train

from ..training.wall_and_lamp import HALF, LAMP, wall_and_lamp

FIELDS = {"schedule.iterations": 150, "response.name": "linear", "plan.enabled": False, "mcmc.cap_density": 12.0}
pytestmark = pytest.mark.usefixtures("few_probes")
CONFIG = load_config("fast", FIELDS)


def without_lamp(scene):
    """The same photos, where a grey wall is in the lamp's place."""
    views = [
        replace(v, codes=np.where(v.codes.min(2, keepdims=True) > 250, np.uint8(77), v.codes)) for v in scene.views
    ]
    return replace(scene, views=tuple(views))


def test_a_missing_lamp_is_named_and_logged(tmp_path, caplog):
    scene = wall_and_lamp()
    run = train(without_lamp(scene), tmp_path / "run", CONFIG, device="cpu")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["unexplained"]["regions"] == 0
    assert "not explained" not in caplog.text
    regions = compare_photos(run.field, scene.views).regions
    assert {region.photo for region in regions} == {view.name for view in scene.views} and len(regions) == 9
    cameras = {view.name: view.camera for view in scene.views}
    for region in regions:
        # From code 77 to white of a linear curve.
        assert region.stops == pytest.approx(np.log2(255 / 77), abs=0.3) and 9 <= region.pixels <= 25
        expected = cameras[region.photo].world_to_camera @ [0, 0, LAMP, 1]
        place = [32 + 70 * expected[0] / LAMP, 32 + 70 * expected[1] / LAMP]
        np.testing.assert_allclose([region.column, region.row], place, atol=70 * HALF / LAMP)
    # The wall behind the lamp is hidden elsewhere in each photo, and is seen in all others: doubt is left all the same.
    confidence, shares = gather_evidence(run.field, scene.views).confidence(), []
    for view in scene.views:
        lamp = torch.from_numpy((view.codes.min(2) > 250).astype(np.float32))
        sums = run.field.weighted_sums(run.field.camera_tensors(view.camera), torch.stack([lamp, 1 - lamp], 2))
        shares.append((sums * confidence[:, None]).sum(0) / sums.sum(0))
    inside, outside = torch.stack(shares).mean(0).tolist()
    assert inside < 0.45 and outside > 0.9
    areas = [region.pixels * abs(region.stops) for region in regions]
    assert areas == sorted(areas, reverse=True)


def test_what_does_not_count_is_not_missing_and_light_that_is_not_there_is(tmp_path, caplog):
    scene = wall_and_lamp()
    run = train(scene, tmp_path / "run", CONFIG, device="cpu")
    assert not compare_photos(run.field, scene.views).regions
    dark = without_lamp(scene)
    assert (
        all(region.stops < -1 for region in compare_photos(run.field, dark.views).regions)
        and "summary" not in caplog.text
    )
    black = compare_photos(run.field, [replace(view, codes=np.zeros_like(view.codes)) for view in scene.views]).regions
    # A black photo says "less than half a code", not "none": from white of a linear curve that is 9 stops.
    assert min(region.stops for region in black) > -np.log2(2 * 255) - 0.01 and black
    half = np.where(np.arange(64)[:, None, None] < 32, 255, 0).repeat(64, 1).repeat(3, 2).astype(np.uint8)
    regions = compare_photos(run.field, [replace(view, codes=half) for view in scene.views]).regions
    # White above, black below: two regions that touch, and not one that is off by nothing in the mean.
    assert min(abs(region.stops) for region in regions) >= 1 and {region.stops > 0 for region in regions} == {
        True,
        False,
    }
    masked = [replace(view, mask=np.zeros((64, 64), np.float32)) for view in dark.views]
    assert compare_photos(run.field, dark.views).regions and not compare_photos(run.field, masked).regions
    # A whole photo of another exposure is told by its offset; clipped pixels do not count.
    names = [view.name for view in scene.views]
    longer = [replace(scene.views[0], exposure_time=scene.views[0].exposure_time / 2), *scene.views[1:]]
    offsets = compare_photos(run.field, longer).brightness_offsets
    assert list(offsets) == names and offsets[names[0]] == pytest.approx(1.0, abs=0.1)
    assert all(abs(offsets[name]) < 0.1 for name in names[1:])
    # A training reports what its photos show and the scene does not hold.
    spoiled = replace(scene, views=(*scene.views[:8], dark.views[8]))
    worst = train(spoiled, tmp_path / "spoiled", CONFIG, device="cpu").summary()["unexplained"]["worst"][0]
    assert worst["photo"] == "v_8" and worst["stops"] < 0
    assert "1 regions in 1 photos are not explained by the scene; the worst: v_8" in caplog.text
