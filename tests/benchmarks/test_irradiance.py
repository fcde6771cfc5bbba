"""Irradiance by direction against maps of the truth."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.irradiance import irradiance_error, read_light_maps
from sehdr_warp.errors import InputError
from sehdr_warp.output.images.exr import rgb_channels, write_exr
from sehdr_warp.output.lighting.environment_map import latlong
from sehdr_warp.scene import Camera

PLACE = np.array([0.5, -1.0, 2.0])
CAMERA = Camera(32, 32, 30.0, 30.0, 16.0, 16.0, np.eye(4))


def light(directions):
    """[..., 3] an uneven sky with a lamp along +X."""
    return 0.2 + 0.1 * directions[..., 1:2] + 50.0 * (directions[..., :1] > 0.98) * [1.0, 0.8, 0.5]


class Stub:
    """A run that shows `factor` times the light, and what is behind (-Z) as `behind`."""

    def __init__(self, factor=1.0, behind=None):
        self.factor, self.behind = factor, behind

    def render_directions(self, position, directions, **_):
        np.testing.assert_array_equal(position, PLACE)
        hdr = self.factor * light(directions)
        hdr = np.where(directions[..., 2:] < 0, self.behind, hdr) if self.behind is not None else hdr
        return SimpleNamespace(hdr=torch.tensor(hdr))


@pytest.fixture
def folder(tmp_path):
    """A set with one map, whose half along -Z no photo shows."""
    fine = latlong(256)
    radiance = light(fine).reshape(32, 4, 64, 4, 3).mean((1, 3))
    upper = 1.0 * (latlong(64)[..., 2] > 0)
    header = {"sehdr:position": json.dumps(PLACE.tolist())}
    (tmp_path / "light").mkdir()
    write_exr(tmp_path / "light" / "place_0.exr", rgb_channels(radiance) | {"A": upper}, header=header, pixel="float")
    return tmp_path


def test_irradiance_counts_light_that_photos_show(folder):
    maps = read_light_maps(folder)
    assert [(each.position.tolist(), each.radiance.shape) for each in maps] == [(PLACE.tolist(), (32, 64, 3))]
    assert irradiance_error(Stub(), maps, [CAMERA]) < 1e-5
    assert irradiance_error(Stub(behind=100.0), maps, [CAMERA]) < 1e-5
    assert irradiance_error(Stub(1.3), maps, [CAMERA]) == pytest.approx(0.3, abs=1e-4)
    assert irradiance_error(Stub(1.3), maps, [CAMERA], scale=1 / 1.3) < 1e-4
    narrow = replace(maps[0], coverage=1.0 * (latlong(64)[..., 2] > 0.99))
    assert irradiance_error(Stub(), [narrow], [CAMERA]) is None, "photos show too little of every hemisphere"


def test_a_lamp_that_is_missing_shows_on_surfaces_that_face_it(folder):
    missing = Stub()
    missing.render_directions = lambda position, directions, **_: SimpleNamespace(
        hdr=torch.tensor(np.minimum(light(directions), 1.0))
    )
    assert 0.2 < irradiance_error(missing, read_light_maps(folder), [CAMERA]) < 1.0


def test_sets_without_maps_have_no_figure_and_damage_is_named(folder, tmp_path):
    assert read_light_maps(tmp_path / "elsewhere") == []
    assert irradiance_error(Stub(), [], []) is None
    write_exr(folder / "light" / "place_1.exr", {"R": np.ones((4, 8))}, header={})
    with pytest.raises(InputError, match="place_1.exr: is no lat-long map"):
        read_light_maps(folder)
