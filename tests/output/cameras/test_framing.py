import numpy as np
import pytest

from sehdr_warp.output.cameras.framing import (
    default_path,
    frame_subject,
    subject_radius,
    visible_surface,
    widescreen_camera,
    widescreen_size,
)
from sehdr_warp.output.cameras.opening import opening_view
from sehdr_warp.output.cameras.paths import orbit, walk, walk_path
from sehdr_warp.runs.run import load_splats
from sehdr_warp.scene import Camera, look_at
from sehdr_warp.splats import write_gaussians

from ..helpers import AnalyticRun, Entry, camera, splats


def around(count, radius, span=360, fov=30):
    """Cameras on a circle or an arc about the origin, with -Y up."""
    focal = 30 / np.tan(np.radians(fov) / 2)
    angles = np.radians(np.linspace(0, span, count, endpoint=False))
    places = [(radius * np.cos(angle), -0.3 * radius, radius * np.sin(angle)) for angle in angles]
    return [Camera(80, 60, focal, focal, 40, 30, look_at(place, up=(0, -1, 0))) for place in places]


def ball(tmp_path, extra=()):
    """A ball of radius 1 about the origin, and a few large Gaussians elsewhere."""
    points = np.random.default_rng(0).normal(size=(1500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    means, scales = np.concatenate([points, *([place] for place, _ in extra)]), [0.05] * 1500
    gaussians = splats(means, [0.95] * len(means))
    gaussians.log_scales[:] = np.log(scales + [size for _, size in extra])[:, None]
    write_gaussians(tmp_path / "ball.ply", gaussians, overwrite=True)
    return load_splats(tmp_path / "ball.ply")


def test_the_subject_fits_into_every_picture(tmp_path):
    run, photos = ball(tmp_path), around(24, 4)
    assert subject_radius(run, photos, np.zeros(3)) == pytest.approx(1, abs=0.15)
    # These photos show three quarters of the ball at a time.
    photos = around(24, 4, fov=24)
    path = [widescreen_camera(each, photos) for each in orbit(photos, 8, 1.0)]
    edge = np.array([np.asarray(run.render(each.within(96)).alpha)[0].max() for each in path])
    assert edge.min() > 0.5
    framed = frame_subject(run, path, photos)
    for each in framed:
        alpha = np.asarray(run.render(each.within(96)).alpha)
        assert max(alpha[0].max(), alpha[-1].max()) < 0.5 and 0.15 < alpha.mean() < 0.6
    assert len({round(each.fx, 6) for each in framed}) == 1


@pytest.mark.parametrize(
    "wide",
    [("equirectangular", 128, 64, 128 / (2 * np.pi), ()), ("OPENCV_FISHEYE", 96, 96, 30.0, (0.0, 0.0, 0.0, 0.0))],
    ids=["panorama", "fisheye"],
)
def test_wide_photos_show_surfaces_where_they_are(tmp_path, wide):
    run = ball(tmp_path)
    projection, width, height, focal, distortion = wide
    middle = width / 2, height / 2
    for target in ((0, 0, 0), (0, 0, 3)):  # The ball is in the middle of the picture, and beside it.
        pose = look_at((3, -1, 0), target, up=(0, -1, 0))
        camera = Camera(width, height, focal, focal, *middle, pose, projection, distortion)
        points, light = visible_surface(run, camera, 0.9)
        assert len(points) > 20 and light.shape == points.shape
        assert (abs(np.linalg.norm(points, axis=1) - 1) < 0.2).mean() > 0.95
        assert (points @ [3, -1, 0] > 0).mean() > 0.95, "the side that faces the camera"


def test_a_path_shows_little_more_than_its_photos(tmp_path):
    """Show twice as much around a ball that fills a third of the photos, and their height along an arc."""
    run = ball(tmp_path)
    for span, height in ((360, 2 * 0.75), (90, 1.0)):
        photos = around(24, 4, span=span, fov=12)
        path = [widescreen_camera(each, photos) for each in orbit(photos, 6, 1.0)]
        for each in frame_subject(run, path, photos):
            assert each.height / each.fy == pytest.approx(height * photos[0].height / photos[0].fy)
            assert each.fx == pytest.approx(each.fy)


def test_a_floater_in_the_way_is_passed(tmp_path, logged):
    photos = around(24, 4)
    path = [widescreen_camera(each, photos) for each in orbit(photos, 24, 1.0)]
    # Just in front of one camera of the path.
    run = ball(tmp_path, extra=[(0.92 * path[6].position, 0.15)])
    framed = frame_subject(run, path, photos)
    assert any("something near blocked" in line for line in logged)
    depth = np.asarray(run.render(framed[6].within(96)).depth)
    assert np.percentile(depth[depth > 0], 10) > 1
    assert np.linalg.norm(framed[18].position - path[18].position) < 1e-6
    moves = np.array([np.linalg.norm(a.position - b.position) for a, b in zip(path, framed, strict=True)])
    assert np.abs(np.diff(moves, append=moves[0])).max() < 0.35


@pytest.mark.parametrize(
    "short, size", [(24, (640, 360)), (480, (1280, 720)), (900, (1920, 1080)), (3000, (1920, 1080))]
)
def test_sizes_of_films(short, size):
    assert widescreen_size([camera(width=short * 2, height=short)]) == size


@pytest.mark.parametrize("width, fx", [(32, 40.0), (64, 40.0), (32, 60.0)])
def test_a_path_has_square_pixels_and_shows_no_more_than_photos_that_have_not(width, fx):
    """Camera paths of Nuke and nerfstudio state one focal length, and films have no pixel aspect ratio."""
    photo = Camera(width, 24, fx, 44.0, width / 2 + 1, 10.0, np.eye(4))
    film = widescreen_camera(photo, [photo])
    assert film.fx == film.fy
    sides = [side / focal for side, focal in ((film.width, film.fx), (film.height, film.fy))]
    assert sides == pytest.approx([min(sides[0], width / fx), min(sides[1], 24 / 44)])
    center, photo_center = ((each.cx - each.width / 2) / each.fx for each in (film, photo))
    assert center == pytest.approx(photo_center)


def street(count=12, bend=0.0, leap=None):
    """Cameras of somebody who walks ahead along +Z with -Y up, sways, and may be placed wrongly from `leap` on."""
    random, cameras = np.random.default_rng(0), []
    for index in range(count):
        place = np.array([0.03 * random.normal(), 0.02 * random.normal(), 0.5 * index])
        place = place + (np.array([8.0, 0, 0]) if leap is not None and index >= leap else 0)
        up = (np.sin(bend * index) + 0.03 * random.normal(), -np.cos(bend * index), 0)
        cameras.append(Camera(80, 60, 50, 50, 40, 30, look_at(place, np.add(place, (0, 0, 1)), up=up)))
    return cameras


def test_a_walk_ahead_is_followed_not_orbited():
    photos = street()
    broken = street(leap=4)
    assert len(walk(photos)) == 12 and walk(photos[:3]) == []
    assert all(view is photo for view, photo in zip(walk(broken), broken[4:], strict=True))
    assert walk(around(24, 4)) == walk(around(24, 4, span=90)) == []
    path = walk_path(photos, 30)
    places = np.stack([each.position for each in path])
    steps = np.diff(places, axis=0)
    assert places[0] == pytest.approx(photos[0].position, abs=0.5) and places[-1, 2] > 5
    sway = np.ptp([photo.position[:2] for photo in photos], axis=0)
    assert (steps[:, 2] > 0).all() and (np.ptp(places[:, :2], axis=0) < 0.6 * sway).all()
    assert all(each.world_to_camera[2, 2] > 0.99 for each in path)
    # Structure from motion has bent this street: the picture stays level all along.
    bent = street(bend=0.05)
    for each, photo in zip(walk_path(bent, 12), bent, strict=True):
        assert abs(each.world_to_camera[0, :3] @ photo.world_to_camera[1, :3]) < 0.15


def test_the_path_of_a_walk_is_in_the_format_of_films(logged):
    run = AnalyticRun()
    run.cameras = [Entry(str(index), "train", each) for index, each in enumerate(street())]
    path = default_path(run, 5)
    assert len(path) == 5 and {(each.width, each.height) for each in path} == {(640, 360)}
    assert any("the photos walk ahead" in line for line in logged)
    assert opening_view(run).position == pytest.approx(run.cameras[0].camera.position)
