"""Rendered rooms of the prior's training: lamps light what is around them as they do in a room."""

import math

import pytest
import torch

from priors import rooms
from priors.rooms import FAR, LAMPS, WALLS, LitRooms, Rooms


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(rooms, "PIXELS", 32)
    monkeypatch.setattr(rooms, "SAMPLES", 1)
    return LitRooms(6, "cpu", 3)


@pytest.fixture
def empty_room():
    """Return a room of one bulb of radius 0.1, 2 meters above a place on its floor."""
    room = Rooms(1, torch.Generator().manual_seed(0))
    for corner in (room.things.low, room.things.high):
        corner[:, WALLS : room.lamps] += FAR
    room.lamp_middle[0, 0], room.lamp_half[0, 0], room.lamp_round[0, 0] = torch.tensor([1.0, 1, 2]), 0.1, True
    return room


@pytest.mark.parametrize("aside", [0.0, 1.5])
def test_a_bulb_lights_a_floor_by_the_square_of_its_distance(empty_room, aside):
    place, up = torch.tensor([1.0 + aside, 1, 0]).expand(1, 400, 3), torch.tensor([0.0, 0, 1]).expand(1, 400, 3)
    distance = math.hypot(2, aside)
    # Radiance 1 of a disc of radius 0.1, over pi; the cosine is 2 / distance.
    expected = 0.1**2 / distance**2 * 2 / distance
    assert float(empty_room.light_from_lamp(0, place, up).mean()) == pytest.approx(expected, rel=0.03)


def test_things_cast_shadows(empty_room):
    empty_room.things.low[0, WALLS], empty_room.things.high[0, WALLS] = (
        torch.tensor([0.5, 0.5, 1.0]),
        torch.tensor([1.5, 1.5, 1.1]),
    )
    place, up = torch.tensor([[[1.0, 1, 0], [9.0, 1, 0]]]), torch.tensor([0.0, 0, 1]).expand(1, 2, 3)
    below, away = empty_room.light_from_lamp(0, place, up)[0].tolist()
    assert below == 0 and away > 0


def test_walls_have_normals_that_point_into_the_room(empty_room):
    middle = empty_room.size[:, None] / 2
    directions = torch.cat([torch.eye(3), -torch.eye(3)])[None]
    hits = empty_room.trace(middle.expand(1, 6, 3), directions)
    met = hits.distance[0] < FAR
    assert met.sum() >= 3 and torch.equal(hits.normal[0, met], -directions[0, met])


def test_lamps_are_seen_at_their_radiance_and_far_above_what_they_light(few):
    assert few.views.isfinite().all() and few.views.min() >= 0
    lamps = few.views[:, :LAMPS].amax((2, 3, 4))
    assert (lamps > 0.9).sum() > 5
    photo = few.take(12, 24)
    assert photo.shape == (12, 3, 24, 24) and photo.min() >= 0
    brightest = photo.amax(1).flatten(1)
    assert (brightest.amax(1) / brightest.median(1).values).median() > 10


def test_a_seed_gives_the_same_rooms_and_photos(few, monkeypatch):
    again, other = LitRooms(6, "cpu", 3), LitRooms(6, "cpu", 4)
    assert torch.equal(few.views, again.views) and not torch.equal(few.views, other.views)
    assert torch.equal(few.take(3, 16), again.take(3, 16))
