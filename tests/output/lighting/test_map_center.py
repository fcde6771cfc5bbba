"""Center of an environment map, and what the map leaves out."""

import json

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.baking import field_of
from sehdr_warp.output.lighting.environment_map import write_environment_map
from sehdr_warp.output.lighting.map_center import map_center
from sehdr_warp.runs.run import Splats

from ..helpers import Entry, camera, lamps, read_exr


def around(count=12, radius=4.0):
    """Cameras on a circle about (0, 0, 0), which all look at it."""
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [camera(position=(radius * np.sin(t), 0.3, radius * np.cos(t)), target=(0, 0, 0)) for t in turns]


def test_a_walk_around_something_is_seen_from_its_middle_without_it(tmp_path, caplog):
    caplog.set_level("INFO")
    cameras = tuple(Entry(str(i), "train", each) for i, each in enumerate(around()))
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


def test_a_walk_is_around_what_cameras_on_all_sides_look_at():
    center = map_center(around())
    np.testing.assert_allclose(center.position, 0, atol=1e-6)
    assert center.beyond == pytest.approx(0.5 * np.hypot(4, 0.3))
    outwards = [camera(position=each.position, target=2 * each.position) for each in around()]
    for photos in (around()[:4], outwards, around()[::6]):  # An arc, a room seen from within, two cameras
        center = map_center(photos)
        np.testing.assert_allclose(center.position, np.mean([each.position for each in photos], axis=0))
        assert center.beyond == 0
    with pytest.raises(SehdrError, match="no cameras, so no center"):
        map_center([])
