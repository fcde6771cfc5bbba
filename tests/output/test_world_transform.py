import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.model.baking import field_of
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.world_transform import WorldTransform, scene_up, world_transform, write_orientation
from sehdr_warp.runs.run import Splats, load_splats
from sehdr_warp.scene import Camera, look_at
from sehdr_warp.scene.gravity import UpDirection
from sehdr_warp.splats import read_gaussians, write_gaussians
from tests.scene.walks import degrees, photos, ring
from tests.splats.samples import gaussians

from .helpers import AnalyticRun, Entry, camera


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
