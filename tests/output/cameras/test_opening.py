import numpy as np
import pytest

from sehdr_warp.output.cameras.framing import widescreen_camera
from sehdr_warp.output.cameras.opening import opening_facts, opening_view
from sehdr_warp.scene import Camera

from ..helpers import Entry
from .test_framing import around, ball


@pytest.mark.parametrize("distance, fov, change", [(2.2, 24, 2.0), (6, 60, 0.6)])
def test_a_page_opens_nearer_than_photos_from_afar_and_farther_than_close_ups(tmp_path, distance, fov, change):
    photos = around(12, distance, fov=fov)
    run = ball(tmp_path)
    run.cameras = tuple(Entry(str(index), "train", each) for index, each in enumerate(photos))
    opening = opening_view(run)
    assert opening is not None and (opening.width, opening.height) == (640, 360)
    assert any(np.allclose(opening.position, photo.position) for photo in photos)
    film = widescreen_camera(photos[0], photos)
    assert film.fx / opening.fx == pytest.approx(change, rel=0.02)
    assert opening.world_to_camera[0, 1] == pytest.approx(0, abs=1e-9)


def test_gaussians_without_cameras_are_looked_at_from_outside_and_not_through_a_wall(tmp_path):
    run = ball(tmp_path)
    facts = opening_facts(run)
    opening = Camera.from_dict(facts["opening"])
    assert np.linalg.norm(opening.position - facts["focus"]) == pytest.approx(facts["size"])
    assert facts["size"] == pytest.approx(2.8, rel=0.05)
    alpha = np.asarray(run.render(opening.within(96)).alpha)
    assert alpha[0].max() < 0.5 and alpha.mean() > 0.2
    wall = [((x, y, 2.0 * np.sign(opening.position[2])), 0.3) for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)]
    assert np.linalg.norm(opening_view(ball(tmp_path, wall)).position) < 2.2
