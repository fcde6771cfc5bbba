"""Dividing photos by space: cores fill it, borders are shared, and what cannot be divided is refused."""

import numpy as np
import pytest

from sehdr_warp.blocks.division import FEWEST_PLACES, LEAST_PHOTOS, MOST_OF_PHOTO, ShownPlaces, divide, largest_count
from sehdr_warp.errors import InputError
from sehdr_warp.scene import Camera, look_at

from ..training.toy import orbit_camera


def street(count: int, length: float = 20.0) -> list[Camera]:
    """Cameras along x that look down at a street, 1 unit above it."""
    places = np.linspace(0, length, count)
    return [Camera(32, 32, 32.0, 32.0, 16.0, 16.0, look_at((x, 0, 1), (x, 0.01, 0), up=(0, 1, 0))) for x in places]


@pytest.fixture
def ground():
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-0.5, 20.5, 3000), rng.uniform(-0.5, 0.5, 3000), np.zeros(3000)])


@pytest.mark.parametrize("count", [2, 3, 5])
def test_cores_fill_space_and_blocks_share_the_photos_at_their_borders(ground, count):
    division = divide("street", street(60), ground, count)
    everywhere = np.random.default_rng(1).uniform(-1e4, 1e4, (2000, 3))
    places = everywhere @ division.axes.T
    assert (np.sum([cell.contains(places) for cell in division.cells], axis=0) == 1).all(), "one core each"
    assert set(np.concatenate(division.photos)) == set(range(60)), "no photo is left out"
    sizes = [len(own) for own in division.photos]
    assert max(sizes) <= 60 / count + 6 and 60 < sum(sizes) < 60 + 6 * count
    owner = division.block_of(ground)
    assert np.allclose(np.bincount(owner) / len(ground), 1 / count, atol=0.06)
    for block, own in enumerate(division.photos):  # A street is cut across.
        assert (np.diff(own) == 1).all() and abs(np.ptp(ground[owner == block, 1]) - 1) < 0.01


def test_blocks_in_the_middle_have_smaller_cores_and_as_many_photos(ground):
    division = divide("street", street(200), ground, 4)
    sizes = [len(own) for own in division.photos]
    assert np.ptp(sizes) <= 3 and sum(sizes) > 220
    shares = np.bincount(division.block_of(ground))[[0, 3, 1, 2]] / len(ground)
    assert min(shares[:2]) > 1.1 * max(shares[2:]), "those at the ends have one border, not two"


def test_many_points_and_photos_take_little_memory():
    points = np.random.default_rng(0).uniform((-1, -1, 0), (1, 1, 0.01), (9 * FEWEST_PLACES, 3))
    places = ShownPlaces.of(street(20, length=0.1), points)
    assert places.parts.shape == (20, FEWEST_PLACES) and places.parts.dtype == np.float32
    assert places.parts.nnz == pytest.approx(20 * MOST_OF_PHOTO, rel=0.5) and places.parts.nnz <= 20 * MOST_OF_PHOTO
    assert places.parts.sum(axis=1) == pytest.approx(np.ones(20), abs=1e-4)
    assert np.abs(places.middles[:, :2]).max() < 0.2, "of all that they show, not of the first points"


def test_photos_of_one_object_cannot_be_divided():
    cameras = [orbit_camera(angle) for angle in np.linspace(0, 6, 40)]
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    with pytest.raises(InputError, match=r"vase: cannot be divided into 2 blocks: .* in 40 of the 40 training photos"):
        divide("vase", cameras, points, 2)
    assert largest_count("vase", cameras, points, 4) is None


def test_photos_that_mostly_show_one_place_are_refused_for_many_blocks(ground):
    cameras = street(18) + [street(18)[0]] * 30
    with pytest.raises(InputError, match=r"training photos cannot be divided into \d blocks: many show the same place"):
        divide("kiosk", cameras, ground, 4)
    assert largest_count("kiosk", cameras, ground, 4) is None


def test_blocks_need_photos(ground):
    with pytest.raises(InputError, match=r"20 training photos are too few for 4 blocks of at least 6; use --blocks 3"):
        divide("street", street(20), ground, 4)
    division = largest_count("street", street(20), ground, 4)
    assert division is not None and len(division.cells) == 20 // LEAST_PHOTOS


def test_the_distance_to_a_border_is_that_to_the_faces_between_cores(ground):
    division = divide("street", street(60), ground, 2)
    at = next(float(cell.high[0]) for cell in division.cells if np.isfinite(cell.high[0]))
    x = division.axes[0]  # Along the street, one way or the other.
    points = np.array([(at + 3.0) * x, (at - 0.5) * x + 7 * division.axes[1]])
    assert division.border_distance(points) == pytest.approx([3.0, 0.5])
