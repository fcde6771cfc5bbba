"""Center of an environment map, and what the map leaves out."""

import json

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.baking import field_of
from sehdr_warp.output.lighting.environment_map import write_environment_map
from sehdr_warp.output.lighting.map_center import find_center
from sehdr_warp.output.world_transform import WorldTransform
from sehdr_warp.runs.run import Splats

from ..helpers import Entry, arc, lamps, read_exr


def test_a_walk_around_something_is_seen_from_its_middle_without_it(tmp_path, caplog):
    caplog.set_level("INFO")
    cameras = tuple(Entry(str(i), "train", each) for i, each in enumerate(arc(12, 360, 4.0, 0.3)))
    scene = Splats(tmp_path / "run", field_of(lamps()), cameras)
    write_environment_map(scene, tmp_path / "env.exr", size=64)
    header = read_exr(tmp_path / "env.exr")[2]
    assert np.abs(json.loads(header["sehdr:position"])).max() < 0.1
    assert float(header["sehdr:beyond"]) == pytest.approx(2, rel=0.01)
    assert "walk around" in caplog.text and "--beyond" in caplog.text
    write_environment_map(scene, tmp_path / "other.exr", size=64, beyond=1.5)
    other = read_exr(tmp_path / "other.exr")[2]
    assert other["sehdr:position"] == header["sehdr:position"] and float(other["sehdr:beyond"]) == 1.5
    write_environment_map(scene, tmp_path / "scaled.exr", size=64, beyond=2.0, scale=1.234)
    assert read_exr(tmp_path / "scaled.exr")[2]["sehdr:beyond"] == "2.0" != repr(2.0 / 1.234 * 1.234)


def test_a_scene_without_cameras_has_no_center(tmp_path):
    scene = Splats(tmp_path / "run", field_of(lamps()), ())
    with pytest.raises(SehdrError, match="no cameras, so no center"):
        find_center(scene, "center", None, WorldTransform.identity())
