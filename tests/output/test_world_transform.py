import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.model.baking import field_of
from sehdr_warp.output.cameras.exchange import camera_path
from sehdr_warp.output.cameras.paths import orbit
from sehdr_warp.output.cameras.selection import select_cameras
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.lighting.environment_map import write_environment_map
from sehdr_warp.output.render_views import render_views
from sehdr_warp.output.world_transform import (
    WorldTransform,
    photos_to_scene,
    scene_up,
    world_transform,
    write_orientation,
)
from sehdr_warp.runs.run import Splats, load_splats
from sehdr_warp.scene import Camera, load_cameras, load_scene, look_at
from sehdr_warp.scene.gravity import UpDirection, is_pitch_known, up_direction
from sehdr_warp.splats import read_gaussians, write_gaussians
from tests.splats.samples import gaussians

from ..make_scenes import write_colmap
from .helpers import AnalyticRun, Entry, camera, read_exr


def photos(up, positions, target, *, roll=0.0, turned=0, seed=0):
    """Cameras that look at a target; hands roll by some degrees, and some hold the camera upright."""
    random = np.random.default_rng(seed)
    cameras = []
    for index, position in enumerate(positions):
        pose = look_at(position, target, up=up)
        angle = math.radians(random.normal(0, roll) + (90 if turned and index % turned == 0 else 0))
        turn = np.eye(4)
        turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        cameras.append(Camera(32, 24, 40, 40, 16, 12, turn @ pose))
    return cameras


def degrees(a, b):
    return math.degrees(math.acos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def ring(count, radius, height, span=360):
    azimuth = np.radians(np.linspace(0, span, count, endpoint=False))
    return np.stack([radius * np.cos(azimuth), np.full(count, height), radius * np.sin(azimuth)], axis=1)


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


def test_photos_that_all_look_one_way_are_said_to_tell_no_pitch(tmp_path, logged):
    """A camera that slides along a table and looks down on it: its tilt cannot be told from a tilted table."""
    positions = [(0.1 * x, 0.1 * y, -2.0) for x in range(4) for y in range(3)]
    poses = [look_at(place, np.add(place, (0, -0.36, 1)), up=(0, 1, 0)) for place in positions]
    cameras = [Camera(32, 24, 40, 40, 16, 12, pose) for pose in poses]
    entries = [Entry(str(i), "train", each) for i, each in enumerate(cameras)]
    scene = Splats(tmp_path / "run", field_of(gaussians()), entries)
    assert degrees(world_transform(scene).rotation[1], np.array([0, 1, 0])) == pytest.approx(19.8, abs=0.1)
    assert any("all look one way" in line and "--up" in line for line in logged)
    logged.clear()
    assert world_transform(scene, up="y").rotation[1] == pytest.approx([0, 1, 0]) and not logged


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


def test_photos_without_a_common_up_are_named(logged):
    random = np.random.default_rng(0)
    poses = Rotation.random(30, random_state=0).as_matrix()
    cameras = []
    for pose, position in zip(poses, random.normal(size=(30, 3))):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose, -pose @ position
        cameras.append(Camera(32, 24, 40, 40, 16, 12, matrix))
    run = AnalyticRun()
    run.cameras = [Entry(str(i), "train", each) for i, each in enumerate(cameras)]
    world_transform(run)
    assert any("share no up direction" in line and "--up x,y,z" in line for line in logged)


def test_photos_that_are_stored_on_their_side_keep_the_up_of_their_training(logged):
    """Poses alone show no up then; the training read how the camera was held."""
    places = ring(12, 4, 1)
    run = AnalyticRun()
    cameras = photos(np.array([0, 1, 0]), places, np.zeros(3), turned=1)
    run.cameras = [Entry(str(i), "train", each) for i, each in enumerate(cameras)]
    run.up = UpDirection(np.array([0, 1.0, 0]), "cameras")
    assert world_transform(run).rotation[1] == pytest.approx([0, 1, 0])
    assert scene_up(run) == pytest.approx([0, 1, 0]) and not logged


def test_a_transform_keeps_what_cameras_see_and_can_be_undone():
    matrix = np.eye(4)
    matrix[:3, :3] = 2.5 * Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    matrix[:3, 3] = 1, -2, 3
    transform, view, points = WorldTransform.from_matrix(matrix), camera(), np.random.default_rng(0).normal(size=(9, 3))

    def pixels(camera_, at):
        local = at @ camera_.world_to_camera[:3, :3].T + camera_.world_to_camera[:3, 3]
        return local[:, :2] / local[:, 2:]

    np.testing.assert_allclose(pixels(transform.camera(view), transform.points(points)), pixels(view, points))
    np.testing.assert_allclose(transform.inverse().points(transform.points(points)), points, atol=1e-12)
    np.testing.assert_allclose(transform.inverse().matrix @ transform.matrix, np.eye(4), atol=1e-12)
    for wrong in (np.diag([1, -1, 1, 1]), np.diag([1, 2, 1, 1]), np.full((4, 4), np.nan), np.eye(3)):
        with pytest.raises(ValueError, match="is not|does not"):
            WorldTransform.from_matrix(wrong)


@pytest.mark.parametrize("suffix, kind", [(".ply", "ldr"), (".ply", "hdr"), (".glb", "ldr"), (".usdc", "hdr")])
def test_gaussians_look_alike_from_transformed_cameras(tmp_path, suffix, kind):
    """Also their harmonics are turned: what a camera sees of an upright file is what it saw of the scene."""
    if suffix == ".usdc":
        pytest.importorskip("pxr")
    source = tmp_path / "source.ply"
    write_gaussians(source, gaussians(degree=3, color_model="display" if kind == "ldr" else "linear"))
    run = load_splats(source)
    run.cameras = tuple(Entry(str(i), "train", camera(position=(i - 1, -1, -6))) for i in range(3))
    export(run, tmp_path / f"a{suffix}", kind=kind, cameras=True, scale=2.0)
    upright = load_splats(tmp_path / f"a{suffix}")
    for before, after in zip(run.cameras, upright.cameras, strict=True):
        assert not np.allclose(before.camera.world_to_camera, after.camera.world_to_camera)
        a, b = run.render(before.camera), upright.render(after.camera)
        np.testing.assert_allclose(b.hdr, a.hdr, rtol=2e-2, atol=2e-3 * float(a.hdr.max()))
        np.testing.assert_allclose(b.depth, 2 * a.depth, rtol=1e-2, atol=1e-2)
    # And back: the file states how it was turned.
    export(upright, tmp_path / f"back{suffix}", kind=kind, axes="scene", scale=1.0)
    back = load_splats(tmp_path / f"back{suffix}")
    rendered = back.render(run.cameras[0].camera).hdr
    expected = run.render(run.cameras[0].camera).hdr
    np.testing.assert_allclose(rendered, expected, rtol=2e-2, atol=2e-3 * float(expected.max()))


def test_upright_files_have_their_up_where_readers_expect_it(tmp_path):
    pytest.importorskip("pxr")
    write_gaussians(tmp_path / "s.ply", gaussians(color_model="display"))
    run = load_splats(tmp_path / "s.ply")
    run.cameras = tuple(
        Entry(str(i), "train", c) for i, c in enumerate(photos((0, 0, 1), ring(9, 4, 1)[:, [0, 2, 1]], (0, 0, 0)))
    )
    heights = {}
    for name in ("a.ply", "a.glb", "a.usdc"):
        export(run, tmp_path / name)
        heights[name] = read_gaussians(tmp_path / name).means[:, 1]
    z = run.field.gaussians.means[:, 2].numpy()
    np.testing.assert_allclose(heights["a.glb"] - heights["a.glb"].mean(), z - z.mean(), atol=1e-3)
    np.testing.assert_allclose(heights["a.usdc"], heights["a.glb"], atol=1e-4)
    np.testing.assert_allclose(heights["a.ply"], -heights["a.glb"], atol=1e-4)


def test_pictures_and_cameras_are_in_one_space(tmp_path):
    run = AnalyticRun()
    render_views(run, tmp_path, aovs="position", scale=3.0, evs=(0,))
    header = read_exr(tmp_path / "hdr" / "t_0.exr")[2]
    bracket = read_exr(next((tmp_path / "brackets" / "t_0").glob("*.exr")))[2]
    assert all(bracket[name] == header[name] for name in ("sehdr:worldMatrix", "sehdr:camera"))
    transform = WorldTransform.from_matrix(json.loads(header["sehdr:worldMatrix"]))
    assert transform.scale == pytest.approx(3)
    stored = Camera.from_dict(json.loads(header["sehdr:camera"]))
    source = run.cameras[3].camera
    np.testing.assert_allclose(stored.position, transform.points(source.position), atol=1e-9)
    # cameras.usda of that space leads back to the scene's own, whatever the axes are then.
    for axes in ("upright", "scene"):
        frame = world_transform(run, axes)
        back = select_cameras(run, tmp_path / "cameras.usda", transform=frame)
        np.testing.assert_allclose(back[0][1].position, source.position, atol=1e-6)


@pytest.mark.parametrize("axes", ["upright", "scene"])
def test_pictures_and_maps_of_a_turned_file_state_the_way_from_the_photos(tmp_path, axes):
    """A run and a file of its Gaussians, turned, moved and scaled: cameras of one fit the other."""
    cameras = tuple(Entry(str(i), "train", camera(position=(0.3 * i, 0.2, -6))) for i in range(3))
    run = Splats(tmp_path / "run", field_of(gaussians(degree=1)), cameras)
    export(run, tmp_path / "turned.ply", kind="hdr", cameras=True, scale=2.0)
    file = load_splats(tmp_path / "turned.ply")
    assert not np.allclose(file.world_matrix, np.eye(4))
    render_views(file, tmp_path / "out", cameras="interpolate", count=3, size="32x24", axes=axes)
    header = read_exr(tmp_path / "out" / "hdr" / "interpolate_000.exr")[2]
    stored = Camera.from_dict(json.loads(header["sehdr:camera"])).position
    photos = WorldTransform.from_matrix(json.loads(header["sehdr:worldMatrix"])).inverse()
    np.testing.assert_allclose(photos.points(stored), cameras[0].camera.position, atol=1e-6)
    write_environment_map(file, tmp_path / "map.exr", size=32, at="camera:1", axes=axes)
    header = read_exr(tmp_path / "map.exr")[2]
    photos = WorldTransform.from_matrix(json.loads(header["sehdr:worldMatrix"])).inverse()
    place = photos.points(json.loads(header["sehdr:position"]))
    np.testing.assert_allclose(place, cameras[1].camera.position, atol=1e-6)
    path = [each for _, each in select_cameras(file, "interpolate", count=3)]
    to_photos, own = photos_to_scene(file).inverse(), [entry.camera for entry in file.cameras]
    for source, scene, expected in (
        ("out/cameras.usda", file, path),
        ("out/camera_path.json", file, path),
        ("out/cameras.usda", run, map(to_photos.camera, path)),
        ("out/camera_path.json", run, map(to_photos.camera, path)),
        ("turned.ply.cameras.json", file, own),
    ):
        for (_, a), b in zip(select_cameras(scene, tmp_path / source), expected, strict=True):
            np.testing.assert_allclose(a.world_to_camera, b.world_to_camera, atol=1e-5)


def test_panoramas_are_not_pinholes_of_usd(tmp_path, logged):
    run = AnalyticRun()
    panorama = replace(run.cameras[0].camera, width=64, height=32, projection="equirectangular")
    entries = [{"name": "pano", **panorama.to_dict()}, {"name": "pinhole", **camera().to_dict()}]
    for name, chosen in (("both", entries), ("one", entries[:1])):
        (tmp_path / f"{name}.json").write_text(json.dumps({"cameras": chosen}))
        files = render_views(run, tmp_path / name, cameras=tmp_path / f"{name}.json")
        stage = tmp_path / name / "cameras.usda"
        assert stage.exists() == (stage in files) == (name == "both")
    text = (tmp_path / "both" / "cameras.usda").read_text()
    assert 'Camera "pinhole"' in text and "pano" not in text
    assert sum(line.startswith("cameras.usda: without pano, because OpenUSD has neither") for line in logged) == 2
    with pytest.raises(SehdrError, match="64x48 would distort a panorama; write one twice as wide as high"):
        render_views(run, tmp_path / "size", cameras=tmp_path / "one.json", size="64x48")


def test_kept_orientation_and_options(tmp_path):
    run = AnalyticRun()
    run.path = tmp_path
    before = world_transform(run)
    write_orientation(run, up=(0, 0, 2))
    assert write_orientation(run, scale=0.5).read_text()
    saved_transform = world_transform(run)
    np.testing.assert_allclose(saved_transform.rotation @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    assert (before.scale, saved_transform.scale) == (1, 0.5)
    np.testing.assert_allclose(world_transform(run, up="-y").rotation @ [0, -1, 0], [0, 1, 0], atol=1e-12)
    assert world_transform(run, "scene").is_identity
    for options, words in (
        ({"up": "1,2"}, "is not a direction"),
        ({"up": "0,0,0"}, "is not a direction"),
        ({"scale": -1.0}, "scale -1.0 is not between"),
        ({"axes": "sideways"}, "is not one of upright, scene"),
        ({"axes": "scene", "up": "y"}, "leave one of them out"),
    ):
        with pytest.raises(SehdrError, match=words):
            world_transform(run, **options)
    (tmp_path / "orientation.json").write_text('{"up": [0, 0]}')
    with pytest.raises(InputError, match="orientation.json: cannot be used"):
        world_transform(run)


def test_a_path_is_one_moving_camera(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    run = AnalyticRun()
    render_views(run, tmp_path, cameras="orbit", count=5, size="32x18", fps=25)
    stage = Usd.Stage.Open(str(tmp_path / "cameras.usda"))
    prims = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    assert [prim.GetName() for prim in prims] == ["orbit"]
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 4, 25)
    path = json.loads((tmp_path / "camera_path.json").read_text())
    assert stage.GetFramesPerSecond() == path["fps"] == 25 and path["seconds"] == pytest.approx(5 / 25)
    expected = select_cameras(run, "orbit", count=5)
    for name in ("cameras.usda", "cameras.chan", "camera_path.json"):
        read = select_cameras(run, tmp_path / name)
        assert len(read) == 5
        for (_, a), (_, b) in zip(expected, read, strict=True):
            np.testing.assert_allclose(b.position, a.position, atol=1e-5)
            np.testing.assert_allclose(b.world_to_camera, a.world_to_camera, atol=1e-5)
            assert b.fy / b.height == pytest.approx(a.fy / a.height, rel=1e-5)


def test_numbered_photos_of_a_colmap_folder_are_not_frames_of_one_camera(tmp_path):
    write_colmap(tmp_path / "set", name="IMG_{:03d}.png")
    render_views(AnalyticRun(), tmp_path / "out", cameras=tmp_path / "set")
    text = (tmp_path / "out/cameras.usda").read_text()
    assert "IMG_000" in text and "IMG_001" in text, "each photo is a camera of its own"
    assert not (tmp_path / "out/camera_path.json").exists()


def test_only_numbered_views_of_one_size_are_a_path():
    views = [(f"shot_{i:04d}", camera()) for i in range(1001, 1004)]
    path = camera_path(views)
    assert path is not None and (path.name, path.frames) == ("shot", [1001, 1002, 1003])
    assert camera_path(views[:1]) is None
    assert camera_path([*views[:2], ("shot_1009", camera())]) is None
    assert camera_path([*views[:2], ("other_1003", camera())]) is None
    assert camera_path([*views[:2], ("shot_1003", camera(width=64))]) is None
    assert camera_path([("left", camera()), ("right", camera())]) is None


def test_several_cameras_are_chosen_from_by_name(tmp_path):
    run = AnalyticRun()
    entries = [{"name": name, **camera().to_dict()} for name in ("a", "a_2000", "b_0001", "b_0002", "c_001")]
    (tmp_path / "c.json").write_text(json.dumps({"cameras": entries}))
    assert [name for name, _ in select_cameras(run, tmp_path / "c.json", camera="b")] == ["b_0001", "b_0002"]
    assert [name for name, _ in select_cameras(run, tmp_path / "c.json", camera="a")] == ["a"]
    with pytest.raises(SehdrError, match="has no camera 'c'"):
        select_cameras(run, tmp_path / "c.json", camera="c")
    with pytest.raises(SehdrError, match="chooses a photo or from a file"):
        select_cameras(run, "orbit", camera="a")
    photo = run.cameras[-1]
    for split in ("train", "test", "all"):
        assert select_cameras(run, split, camera=photo.name) == [(photo.name, photo.camera)]
    for cameras, message in (
        (run.cameras, rf"one of the scene's.*did you mean {photo.name}"),
        ([], "no cameras, and so"),
    ):
        run.cameras = cameras
        with pytest.raises(SehdrError, match=message):
            select_cameras(run, "test", camera=f"{photo.name}x")
    assert len(load_cameras(tmp_path / "c.json")) == 5


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
