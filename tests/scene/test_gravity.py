"""Up by GPS, by vertical lines and by poses: of rendered rooms, whose Z is up, and of flights with places in EXIF."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import rotate
from scipy.spatial.transform import Rotation

from sehdr_warp.output.cameras.paths import orbit
from sehdr_warp.scene import Camera, Scene, View, load_scene, look_at
from sehdr_warp.scene.gravity import UpDirection, find_up, is_pitch_known, looks_down, up_direction, up_from_lines

from .walks import degrees, photos, ring

UP = np.array([0.0, 0, 1])


def scene(views):
    return Scene("set", "photos", tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def room(name):
    return load_scene(f"embedded:{name}", response="srgb")


@pytest.mark.parametrize("name, by_poses", [("metal", 19), ("overcast", 9), ("window", 2)])
def test_lines_tell_the_pitch_of_cameras_that_look_one_way(name, by_poses):
    photos = room(name)
    assert degrees(up_direction([view.camera for view in photos.train_views])) > by_poses
    up = find_up(photos)
    assert up.source == "lines" and degrees(up.direction) < 3.5


@pytest.mark.parametrize("name", ["study", "sunlit", "room"])
def test_lines_leave_what_poses_know(name):
    up = find_up(room(name))
    assert up.source == "lines" and degrees(up.direction) < 1.2


def flight(folder, noise=0.0, south=False, longitude=-16.0):
    """Photos straight down with one heading, 40 m above the ground, in a world of 7 m a unit that lies askew."""
    random = np.random.default_rng(1)
    turn = Rotation.from_euler("xyz", [40, 70, 110], degrees=True).as_matrix()
    views = []
    for index in range(12):
        east, north = 15.0 * (index % 4), 12.0 * (index // 4)
        place = np.array([east, north, 40.0])
        pose = look_at(place / 7, place / 7 - UP, up=(0, 1, 0.0))
        pose[:3, :3] = pose[:3, :3] @ turn.T
        place = place + random.normal(0, noise, 3)
        exif, meters = Image.Exif(), 6_371_000 * np.pi / 180
        east = longitude + place[0] / meters / np.cos(np.radians(48))
        angles = (-48.0 if south else 48.0) + place[1] / meters, (east + 180) % 360 - 180
        table = exif.get_ifd(0x8825)
        for tag, angle, names in ((1, angles[0], "NS"), (3, angles[1], "EW")):
            table[tag], size = names[int(angle < 0)], abs(angle)
            table[tag + 1] = (int(size), int(size * 60 % 60), size * 3600 % 60)
        table[5], table[6] = b"\0", place[2] + 300
        path = folder / f"{index}.jpg"
        Image.new("RGB", (32, 24), (90, 90, 90)).save(path, exif=exif)
        codes = np.zeros((24, 32, 3), np.uint8)
        views.append(View(str(index), codes, Camera(32, 24, 30, 30, 16, 12, pose), 1.0, "train", source=path))
    return scene(views), turn @ UP


@pytest.mark.parametrize("south, longitude", [(False, -16.0), (True, -16.0), (True, 179.9997)])
def test_places_in_exif_tell_up_and_the_unit(tmp_path, south, longitude):
    """The last flight crosses the 180th meridian."""
    photos, truth = flight(tmp_path, noise=0.2, south=south, longitude=longitude)
    assert degrees(up_direction([view.camera for view in photos.views]), truth) > 20
    up = find_up(photos)
    assert up.source == "gps" and degrees(up.direction, truth) < 1 and up.unit == pytest.approx(7, rel=0.02)
    again = UpDirection.from_dict(up.to_dict())
    assert again is not None and again.direction == pytest.approx(up.direction) and again.unit == up.unit


@pytest.mark.parametrize("altitude", [1e6, 1e308, float("nan"), float("-inf")])
def test_altitudes_that_cannot_be_are_not_used(tmp_path, monkeypatch, altitude):
    photos, _ = flight(tmp_path)
    table = {1: "N", 2: (48.0, 0.0, 0.0), 3: "E", 4: (16.0, 0.0, 0.0), 6: altitude}
    monkeypatch.setattr(Image.Exif, "get_ifd", lambda exif, tag: table)
    assert find_up(photos).source == "cameras"


def test_places_of_other_planets_are_not_used(tmp_path):
    """A run states meters a unit up to a million; it could not be read with more."""
    photos, _ = flight(tmp_path)
    views = [
        replace(view, camera=replace(view.camera, world_to_camera=shrunk(view.camera.world_to_camera, 1e-6)))
        for view in photos.views
    ]
    assert find_up(scene(views)).source == "cameras"


def shrunk(pose, factor):
    pose = pose.copy()
    pose[:3, 3] *= factor
    return pose


def test_places_that_do_not_fit_the_poses_are_not_used(tmp_path):
    photos, _ = flight(tmp_path, noise=8.0)
    assert find_up(photos).source == "cameras" and UpDirection.from_dict(None) is None
    views = [replace(view, source=None) for view in flight(tmp_path)[0].views]
    assert find_up(scene(views)).source == "cameras"


def test_lines_right_cameras_that_are_rolled_alike():
    """A camera is screwed onto its tripod askew, and looks one way."""
    views = []
    for view in room("window").train_views:
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", 6, degrees=True).as_matrix()
        codes = rotate(view.codes, -6, reshape=False, order=1)[20:-20, 20:-20]  # Without the corners that turned in
        camera = replace(view.camera, world_to_camera=turn @ view.camera.world_to_camera)
        camera = replace(camera, width=160, height=160, cx=camera.cx - 20, cy=camera.cy - 20)
        views.append(View(view.name, codes, camera, view.exposure_time, "train"))
    poses = up_direction([view.camera for view in views])
    lines = up_from_lines(views, poses)
    assert degrees(poses) == pytest.approx(6, abs=1) and lines is not None and degrees(lines) < 2


def test_photos_without_lines_leave_the_up_of_their_poses():
    random = np.random.default_rng(0)
    views = []
    for index, view in enumerate(room("study").train_views):
        codes = random.integers(0, 256, (60, 80, 3), np.uint8)
        views.append(View(str(index), codes, view.camera.resized(80, 60), 1.0, "train"))
    up = find_up(scene(views))
    assert up.source == "cameras" and up.direction == pytest.approx(up_direction([view.camera for view in views]))


def test_phone_photos_stored_on_their_side_stand_upright(tmp_path):
    """Structure from motion that reads pixels as stored; EXIF says how the photos were held."""
    views = load_scene("embedded:study", response="srgb", max_size=96).train_views
    frames = []
    for view in views:
        camera, exif = view.camera, Image.Exif()
        exif[0x0112] = 6  # The stored picture is turned a quarter to the left.
        Image.fromarray(np.rot90(view.codes)).save(tmp_path / f"{view.name}.jpg", exif=exif, quality=95)
        to_stored = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        pose = np.linalg.inv(to_stored @ camera.world_to_camera) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{view.name}.jpg", "transform_matrix": pose.tolist()})
    lens = {"fl_x": camera.fy, "fl_y": camera.fx, "cx": camera.cy, "cy": camera.width - camera.cx}
    size = {"w": camera.height, "h": camera.width}
    (tmp_path / "transforms.json").write_text(json.dumps(lens | size | {"frames": frames}))
    scene = load_scene(tmp_path, response="srgb")
    assert degrees(up_direction([view.camera for view in scene.views])) > 80
    assert degrees(find_up(scene).direction) < 2
    assert not looks_down([view.camera for view in scene.views], UP)


@pytest.mark.parametrize(
    "name, positions, target, options",
    [
        ("a walk around, looking down", ring(40, 4, 3), (0, 0, 0), {}),
        ("hands", ring(60, 4, 2), (0, 0, 0), {"roll": 3}),
        ("half an arc, looking down", ring(30, 4, 2, span=150), (0, 0, 0), {"roll": 2}),
        ("some turned by a quarter", ring(60, 4, 1), (0, 0, 0), {"roll": 2, "turned": 3}),
    ],
)
def test_up_is_within_three_degrees(name, positions, target, options):
    turn = Rotation.from_euler("xyz", [40, 70, 110], degrees=True).as_matrix()
    up = turn @ [0, 1, 0]
    cameras = photos(up, positions @ turn.T, turn @ np.array(target), **options)
    assert degrees(up_direction(cameras), up) < 3, name


@pytest.mark.parametrize("room", ["room", "lamps", "glass", "study", "sunlit"])
def test_rooms_whose_cameras_turn_are_upright_within_a_degree(room):
    cameras = [view.camera for view in load_scene(f"embedded:{room}", max_size=32, response="srgb").train_views]
    direction = up_direction(cameras)
    assert degrees(direction, np.array([0, 0, 1])) < 1 and is_pitch_known(cameras, direction)


def test_up_of_a_flight_that_looks_straight_down():
    positions = [(x, 30.0, z) for x in range(4) for z in range(4)]
    cameras = []
    for index, position in enumerate(positions):
        heading = math.radians(90 * (index % 4))
        ahead = (math.cos(heading), 0, math.sin(heading))
        cameras.append(Camera(32, 24, 40, 40, 16, 12, look_at(position, np.array(position) - (0, 9, 0), up=ahead)))
    assert degrees(up_direction(cameras), np.array([0, 1, 0])) < 1
    # So an orbit looks at the ground from their height.
    for each in orbit(cameras, 5, 30.0):
        assert each.position[1] == pytest.approx(30, abs=1) and each.world_to_camera[2, 1] < -0.9


def test_up_of_a_flight_to_and_fro():
    """The level axes of all pictures lie along one line, which says nothing of what is up."""
    random, cameras = np.random.default_rng(0), []
    for index in range(20):
        position = np.array([index % 5, 20.0, index // 5])
        ahead = (0, 0, 1 if index // 5 % 2 else -1)
        target = position - (*random.normal(0, 0.08, 1), 1, *random.normal(0, 0.08, 1))
        cameras.append(Camera(32, 24, 40, 40, 16, 12, look_at(position, target, up=ahead)))
    assert degrees(up_direction(cameras), np.array([0, 1, 0])) < 3
    for each in orbit(cameras, 5, 20.0):
        assert each.position[1] == pytest.approx(20, abs=1) and each.world_to_camera[2, 1] < -0.9
