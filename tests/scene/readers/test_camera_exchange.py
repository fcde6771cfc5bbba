import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_cameras

pxr = pytest.importorskip("pxr")
from pxr import Gf, Usd, UsdGeom  # noqa: E402

POSE = Gf.Matrix4d().SetLookAt(Gf.Vec3d(1, 2, 5), Gf.Vec3d(0, 0.5, 0), Gf.Vec3d(0, 1, 0)).GetInverse()


def stage_of(path, *, up="Y", meters=None, frames=None):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    if meters is not None:
        UsdGeom.SetStageMetersPerUnit(stage, meters)
    if frames:
        stage.SetStartTimeCode(frames[0])
        stage.SetEndTimeCode(frames[1])
    return stage


def lens(stage, path, pose=None):
    camera = UsdGeom.Camera.Define(stage, path)
    camera.CreateFocalLengthAttr(24.0)
    camera.CreateHorizontalApertureAttr(36.0)
    camera.CreateVerticalApertureAttr(20.25)
    if pose is not None:
        camera.AddTransformOp().Set(pose)
    return camera


@pytest.fixture
def upright(tmp_path):
    """The camera as a stage with +Y up and in meters has it."""
    stage = stage_of(tmp_path / "plain.usda")
    lens(stage, "/cam1", POSE)
    stage.GetRootLayer().Save()
    [(_, camera)] = load_cameras(tmp_path / "plain.usda")
    return camera


def test_a_parent_moves_its_camera(tmp_path, upright):
    stage = stage_of(tmp_path / "shot.usda", frames=(1001, 1004))
    move = UsdGeom.Xform.Define(stage, "/rig").AddTranslateOp()
    lens(stage, "/rig/cam1", POSE)
    for frame in range(1001, 1005):
        move.Set(Gf.Vec3d(0.1 * (frame - 1001), 0, 0), frame)
    stage.GetRootLayer().Save()
    cameras = load_cameras(tmp_path / "shot.usda")
    assert [name for name, _ in cameras] == [f"cam1_{frame}" for frame in range(1001, 1005)]
    for index, (_, camera) in enumerate(cameras):
        np.testing.assert_allclose(camera.position, upright.position + np.array([0.1 * index, 0, 0]), atol=1e-9)


def test_frames_follow_samples_where_the_stage_states_none(tmp_path):
    stage = stage_of(tmp_path / "shot.usda")
    operation = lens(stage, "/cam1").AddTransformOp()
    for frame in (5, 7):
        operation.Set(POSE, frame)
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/cam1"))
    camera.GetFocalLengthAttr().Set(20.0, 5)
    camera.GetFocalLengthAttr().Set(40.0, 7)
    stage.GetRootLayer().Save()
    cameras = load_cameras(tmp_path / "shot.usda")
    assert [name for name, _ in cameras] == ["cam1_0005", "cam1_0007"]
    assert cameras[1][1].fx == pytest.approx(2 * cameras[0][1].fx)


def test_up_axis_and_units_are_those_of_the_stage(tmp_path, upright):
    turned = POSE * Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 0, 0), 90))
    stage = stage_of(tmp_path / "z.usda", up="Z", meters=1)
    lens(stage, "/cam1", turned)
    stage.GetRootLayer().Save()
    centimeters = Gf.Matrix4d(POSE)
    centimeters.SetTranslateOnly(POSE.ExtractTranslation() * 100)
    stage = stage_of(tmp_path / "cm.usda", meters=0.01)
    lens(stage, "/cam1", centimeters)
    stage.GetRootLayer().Save()
    for name in ("z.usda", "cm.usda"):
        [(_, camera)] = load_cameras(tmp_path / name)
        np.testing.assert_allclose(camera.world_to_camera, upright.world_to_camera, atol=1e-6, err_msg=name)


def test_a_missing_up_axis_is_said_and_a_wrong_one_refused(tmp_path, upright, logged):
    lens(stage := stage_of(tmp_path / "a.usda"), "/cam1", POSE)
    stage.GetRootLayer().Save()
    text = (tmp_path / "a.usda").read_text()
    (tmp_path / "none.usda").write_text(text.replace('    upAxis = "Y"\n', ""))
    [(_, camera)] = load_cameras(tmp_path / "none.usda")
    np.testing.assert_allclose(camera.world_to_camera, upright.world_to_camera, atol=1e-6)
    assert sum("states no upAxis; +Y counts as up" in line for line in logged) == 1
    (tmp_path / "x.usda").write_text(text.replace('upAxis = "Y"', 'upAxis = "X"'))
    with pytest.raises(InputError, match="its upAxis is 'X'"):
        load_cameras(tmp_path / "x.usda")


def test_cameras_of_one_name_get_their_path(tmp_path):
    stage = stage_of(tmp_path / "two.usda")
    for parent in ("left", "right"):
        lens(stage, f"/{parent}/cam", POSE)
    lens(stage, "/main", POSE)
    stage.GetRootLayer().Save()
    assert [name for name, _ in load_cameras(tmp_path / "two.usda")] == ["left_cam", "right_cam", "main"]


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda camera: camera.GetFocalLengthAttr().Set(0.0), "focal length 0 and apertures .* must be positive"),
        (lambda camera: camera.AddScaleOp().Set(Gf.Vec3f(-1, 1, 1)), "mirrored"),
        (lambda camera: camera.AddScaleOp().Set(Gf.Vec3f(0, 1, 1)), "scaled to nothing"),
        (lambda camera: camera.CreateProjectionAttr("orthographic"), "orthographic"),
    ],
)
def test_bad_cameras_are_named(tmp_path, change, words):
    stage = stage_of(tmp_path / "bad.usda")
    change(lens(stage, "/cam1", POSE))
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match=words):
        load_cameras(tmp_path / "bad.usda")


def test_chan_lines(tmp_path):
    file = tmp_path / "move.chan"
    file.write_text("# Nuke\n1 0 0 5 0 0 0 40\n2\t1 0 5 0 90 0 40\n")
    (first, a), (_, b) = load_cameras(file)
    assert first == "move_0001" and (a.width, a.height) == (1920, 1080)
    np.testing.assert_allclose(a.position, (0, 0, 5))
    np.testing.assert_allclose(a.world_to_camera[2, :3], (0, 0, -1), atol=1e-12)
    np.testing.assert_allclose(b.world_to_camera[2, :3], (-1, 0, 0), atol=1e-12)
    assert a.fy == pytest.approx(540 / np.tan(np.radians(20)))
    for text, words in (("1 0 0 5 0 0 0\n", "line 1 is not frame"), ("1 0 0 5 0 0 0 0\n", "field of view 0")):
        file.write_text(text)
        with pytest.raises(InputError, match=words):
            load_cameras(file)
