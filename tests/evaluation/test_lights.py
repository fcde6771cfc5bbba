"""Lights of a made-up truth: discs where cameras see three places."""

import numpy as np
import pytest
from scipy import ndimage

from sehdr_warp.evaluation.lights import count_lights, light_regions
from sehdr_warp.scene import Camera, look_at

PLACES = np.array([[0.0, 0.0, 0.0], [0.8, 0.3, -0.5], [-0.7, -0.4, 0.6]])
CAMERAS = [
    Camera(96, 72, 80.0, 80.0, 48.0, 36.0, look_at(np.array([x, 0.2, -4.0]), np.zeros(3), up=(0.0, 1.0, 0.0)))
    for x in (-1.5, -0.5, 0.5, 1.5)
]


def picture(camera, places, radius=3.0):
    image = np.full((camera.height, camera.width), 0.01)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    for place in places:
        x, y, depth = camera.world_to_camera[:3, :3] @ place + camera.world_to_camera[:3, 3]
        middle = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        image[np.hypot(columns - middle[0], rows - middle[1]) < radius] = 50.0
    return image


def compare(render, radius=3.0, clipped=lambda camera: None):
    regions = []
    for index, camera in enumerate(CAMERAS):
        truth = picture(camera, PLACES, radius)
        regions += light_regions(truth, render(index, camera), camera, clipped(camera))
    return count_lights(regions)


def count(render, radius=3.0):
    comparison = compare(render, radius)
    return {name: comparison[name] for name in ("count", "lost")}


@pytest.mark.parametrize("views, lost", [(2, 0), (3, 1)])
def test_a_light_is_lost_where_most_views_lack_it(views, lost):
    assert count(lambda index, camera: picture(camera, PLACES[index < views :]))["lost"] == lost


def test_specks_and_what_one_view_shows_are_no_lights():
    assert count(lambda _, camera: picture(camera, PLACES), radius=1.0) == {"count": 0, "lost": 0}
    alone = light_regions(picture(CAMERAS[0], PLACES[:1]), picture(CAMERAS[0], []), CAMERAS[0])
    assert len(alone) == 1 and count_lights(alone)["count"] == 0


def test_energy_is_that_of_clipped_lights_and_of_what_is_blurred_around_them():
    def clipped(camera):
        return picture(camera, PLACES[:2]) > 1

    assert compare(lambda _, camera: picture(camera, PLACES))["energies"] == []
    assert compare(lambda _, camera: picture(camera, PLACES), clipped=clipped)["energies"] == pytest.approx([1, 1])
    brighter = compare(lambda _, camera: 3 * picture(camera, PLACES[1:]), clipped=clipped)
    assert brighter["energies"] == pytest.approx([0, 3], abs=0.01)
    blurred = compare(lambda _, camera: ndimage.uniform_filter(picture(camera, PLACES), 3), clipped=clipped)
    assert blurred["lost"] == 0 and blurred["energies"] == pytest.approx([1, 1], abs=0.02)
