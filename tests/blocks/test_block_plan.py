"""blocks.json as somebody may have sent it: names and links that lead elsewhere, and odd shapes."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from sehdr_warp.blocks.block_plan import FILE, MOST_BLOCKS, Block, BlockPlan, blocks_for, make_block_plan
from sehdr_warp.blocks.train import train_in_blocks
from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import load_config, override_config
from sehdr_warp.scene import Camera
from sehdr_warp.scene.normalization import Normalization
from sehdr_warp.training.compensation import SharedDecisions
from sehdr_warp.training.plan import make_plan
from tests.make_scenes import edited_json
from tests.training.toy import toy_scene, with_smaller_photos

DATA = {"path": "photos"}


@pytest.fixture
def plan(tmp_path):
    """Two halves of space with a photo each, in tmp_path/run."""
    (tmp_path / "run").mkdir()
    halves = ([None] * 3, [0.0, None, None]), ([0.0, None, None], [None] * 3)
    blocks = [
        Block(name=f"block_{n}", views=[f"photo_{n}"], fraction=0.5, low=low, high=high, margin=[1.0] * 3)
        for n, (low, high) in enumerate(halves)
    ]
    shared, place = SharedDecisions(0.5, None), Normalization(np.zeros(3), 1.0)
    times = {"photo_0": 0.5, "photo_1": 0.25}
    response, cameras = response_by_name("srgb"), {"photo_0": Camera(4, 3, 5.0, 5.0, 2.0, 1.5, np.eye(4))}
    sizes = {"photo_0": 9}
    plan = BlockPlan("town", DATA, response, place, shared, times, sizes, cameras, Config(), np.eye(3), tuple(blocks))
    plan.write(tmp_path / "run")
    return plan


def test_a_plan_is_read_as_it_was_written(tmp_path, plan):
    read = BlockPlan.read(tmp_path / "run")
    assert (read.scene, read.data, read.exposure_times) == ("town", DATA, plan.exposure_times)
    assert [(block.name, block.views, block.fraction) for block in read.blocks] == [
        (block.name, block.views, block.fraction) for block in plan.blocks
    ]
    assert read.cameras["photo_0"].to_dict() == plan.cameras["photo_0"].to_dict()
    assert read.blocks[0].cell.high[0] == 0 and np.isinf(read.blocks[0].cell.low).all()


def test_blocks_agree_on_opacity_compensation_whatever_their_photos(plan):
    mixed = with_smaller_photos(toy_scene(), 1 / 3)
    assert make_plan(mixed, Config()).config.model.antialiased
    for block in plan.blocks:
        assert not make_plan(mixed, plan.config_of(block)).config.model.antialiased
    on = replace(plan, shared=replace(plan.shared, antialiased=True))
    for block in on.blocks:
        assert make_plan(toy_scene(), on.config_of(block)).config.model.antialiased


@pytest.mark.parametrize(("table", "field"), [("model", "order_angle"), ("loss", "transmittance_weight")])
def test_plans_without_new_fields_train_as_earlier_versions_did(tmp_path, plan, table, field):
    file = tmp_path / "run" / FILE
    values = json.loads(file.read_text())
    del values["config"][table][field]
    file.write_text(json.dumps(values))
    read = BlockPlan.read(tmp_path / "run").config.model_dump()
    assert plan.config.model_dump()[table][field] > read[table][field] == 0


def test_plans_without_opacity_compensation_have_that_of_their_config(tmp_path, plan):
    file = tmp_path / "run" / FILE
    values = json.loads(file.read_text())
    del values["antialiased"]
    for on in (True, False):
        values["config"]["model"]["antialiased"] = on
        file.write_text(json.dumps(values))
        assert BlockPlan.read(tmp_path / "run").shared.antialiased == on


@pytest.mark.parametrize(
    ("fields", "max_size", "on"),
    [
        ({}, None, True),
        ({}, 24, False),
        ({"plan.enabled": False}, None, False),
        ({"plan.keep": ["model.antialiased"]}, None, False),
        ({"plan.enabled": False, "model.antialiased": True}, 24, True),
    ],
)
def test_opacity_compensation_is_decided_once_by_the_photos_of_the_training(
    survey, tmp_path, monkeypatch, fields, max_size, on
):
    """A set is divided by reduced photos, which may all have one size."""
    shutil.copytree(survey, tmp_path / "town")
    for file in sorted((tmp_path / "town" / "images").iterdir())[1::4]:
        with Image.open(file) as photo:
            photo.resize((24, 18)).save(file)
    monkeypatch.setattr("sehdr_warp.blocks.block_plan.LARGEST_SIDE", 24)
    data = {"path": str(tmp_path / "town"), "exposure_index": None, "max_size": max_size, "holdout": None}
    plan = make_block_plan(data, override_config(Config(), {"response.name": "srgb"} | fields), torch.device("cpu"), 2)
    assert plan is not None
    plan.write(tmp_path)
    assert all(plan.config_of(block).model.antialiased == on for block in BlockPlan.read(tmp_path).blocks)
    assert BlockPlan.read(tmp_path).shared.antialiased == on


@pytest.mark.parametrize(
    "fields, named",
    [
        ({"name": "../../other"}, "blocks.name"),
        ({"name": "/tmp/other"}, "blocks.name"),
        ({"name": "block_1"}, "two blocks have the same name"),
        ({"views": ["photo_9"]}, "exposure_times lacks photo_9"),
        ({"margin": [1.0]}, "blocks.margin"),
        ({"low": [None] * 4}, "blocks.low"),
        ({"low": [9.0] * 3}, "is not a box"),
    ],
)
def test_blocks_that_cannot_be(tmp_path, plan, fields, named):
    path = tmp_path / "run" / FILE
    with edited_json(path) as values:
        values["blocks"][0] |= fields
    with pytest.raises(InputError, match=named):
        BlockPlan.read(tmp_path / "run")


@pytest.mark.parametrize(
    "fields",
    [
        {"axes": [[1.0, 0.0, 0.0]]},
        {"blocks": []},
        {"base_time": 0},
        {"format": 9},
        {"cameras": {"photo_0": {"width": 4}}},
    ],
)
def test_plans_that_cannot_be(tmp_path, plan, fields):
    path = tmp_path / "run" / FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))
    with pytest.raises(InputError, match=f"{FILE}: .*{next(iter(fields))}"):
        BlockPlan.read(tmp_path / "run")


@pytest.mark.parametrize(
    "change, problem",
    [
        (lambda values: values.pop("base_time"), "base_time is missing"),
        (lambda values: values["blocks"][0].pop("views"), "blocks.views is missing"),
        (lambda values: values["normalization"].pop("unit"), "normalization.unit is missing"),
        (lambda values: values.update(scene=dict(values)), "scene = {...}: input should be a valid string"),
    ],
)
def test_a_field_that_is_missing_is_named_without_what_is_there(tmp_path, plan, change, problem):
    path = tmp_path / "run" / FILE
    with edited_json(path) as values:
        change(values)
    with pytest.raises(InputError) as error:
        BlockPlan.read(tmp_path / "run")
    assert str(error.value) == f"{path}: {problem}; train again, with overwrite=True"


def test_more_blocks_than_can_be(tmp_path, plan):
    path = tmp_path / "run" / FILE
    with edited_json(path) as values:
        values["blocks"] = [values["blocks"][0] | {"name": f"block_{number}"} for number in range(MOST_BLOCKS + 1)]
    with pytest.raises(InputError, match=f"{FILE}: blocks.*at most {MOST_BLOCKS}"):
        BlockPlan.read(tmp_path / "run")


@pytest.mark.parametrize(
    "flag, place",
    [
        ("resume", "blocks"),
        ("resume", "blocks/block_1"),
        ("resume", FILE),
        ("overwrite", "blocks"),
        ("overwrite", FILE),
    ],
)
def test_links_in_the_run_are_not_followed(tmp_path, plan, flag, place):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "notes.txt").write_text("mine")
    link = tmp_path / "run" / place
    link.parent.mkdir(exist_ok=True)
    target = theirs
    if place == FILE:
        target = link.rename(theirs / FILE)
    link.symlink_to(target)
    before = {path: path.read_bytes() for path in theirs.iterdir()}
    with pytest.raises(InputError, match="is a link"):
        train_in_blocks(DATA, tmp_path / "run", Config(), 2, device=torch.device("cpu"), **{flag: True})
    assert {path: path.read_bytes() for path in theirs.iterdir()} == before


def test_the_number_of_blocks_follows_photos_and_gaussians():
    config = Config()
    assert blocks_for(400, 400 * 1e6, config) == 1
    assert blocks_for(1200, 1200 * 1e6, config) == 4, "30,000 steps are for 400 photos"
    assert blocks_for(20_000, 20_000 * 20e6, config) == 65
    assert blocks_for(300, 300 * 100e6, config) == 9, "3 million Gaussians for each"
    named = override_config(config, {"densification.cap_max": 10**6, "plan.keep": ["densification.cap_max"]})
    assert blocks_for(300, 300 * 100e6, named) == 1
    for preset in ("fast", "demo"):
        assert blocks_for(57, 57 * 1e6, load_config(preset)) == 1, "a quick look at few photos is one training"
        assert blocks_for(1200, 1200 * 1e6, load_config(preset)) == 4
    larger = override_config(config, {"densification.cap_max": 30 * 10**6})
    assert blocks_for(300, 300 * 100e6, larger) == 1
