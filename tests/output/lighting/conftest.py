"""Six lamps around three cameras, without and with lights that are found in them."""

import pytest

from sehdr_warp.model.baking import field_of
from sehdr_warp.output.lighting import lights
from sehdr_warp.runs.run import Splats

from ..helpers import LIGHTS, Entry, camera, lamps, received


@pytest.fixture
def six_lamps(tmp_path):
    cameras = tuple(Entry(str(i), "train", camera(position=(0.1 * i - 0.1, 0, 0), target=(0, 0, 9))) for i in range(3))
    return Splats(tmp_path / "run", field_of(lamps()), cameras)


@pytest.fixture
def run(six_lamps):
    return six_lamps


@pytest.fixture
def lit(six_lamps, monkeypatch):
    """Three of the lamps belong to two lights, which reach every place with their radiance."""
    six_lamps.find_lights = lambda: LIGHTS
    monkeypatch.setattr(lights, "received_light", lambda field, place, *_, **__: received(place))
    return six_lamps
