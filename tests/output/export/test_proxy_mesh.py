"""A proxy mesh against surfaces that are known: a ball on a floor, seen from all around."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.model.baking import field_of
from sehdr_warp.model.lights import Light, LightShape
from sehdr_warp.output.export.proxy_mesh import find_ground, mesh_depth, proxy_mesh, write_proxy_mesh
from sehdr_warp.output.export.splat_edits import Box
from sehdr_warp.output.world_transform import WorldTransform
from sehdr_warp.scene import Camera, look_at
from sehdr_warp.scene.gravity import UpDirection
from sehdr_warp.scene.wide_camera import pixel_directions

from ...full_disk import full_disk
from ..helpers import AnalyticRun, Entry, rendered_view, splats

pytest.importorskip("skimage")
RADIUS, FLOOR = 0.6, -0.6  # The ball lies on the floor, its center at the origin; +Y is up
RED, GREY = (2.0, 0.1, 0.1), (0.2, 0.2, 0.2)


def around(angle, height=1.2, distance=2.6, size=128):
    position = (distance * np.sin(angle), height, distance * np.cos(angle))
    pose = look_at(position, (0, -0.2, 0), up=(0, 1, 0))
    return Camera(size, size, 150.0, 150.0, size / 2, size / 2, pose)


class BallOnFloor(AnalyticRun):
    """A red ball on a grey floor, as a run renders it."""

    def __init__(self):
        super().__init__(names=())
        angles = np.arange(12) * 2 * np.pi / 12
        self.cameras = [Entry(f"v_{i}", "train", around(angle)) for i, angle in enumerate(angles)]
        self.cameras += [Entry("t_0", "test", around(0.2, 1.0))]

    def render(self, view):
        """Intersect the rays of a camera with ball and floor."""
        local = pixel_directions(view)  # Of wide cameras depth is distance.
        local = local / local[..., 2:] if view.is_pinhole else local
        rays, origin = local @ view.world_to_camera[:3, :3], view.position
        a, b = (rays**2).sum(2), (rays * origin).sum(2)
        root = b**2 - a * (origin @ origin - RADIUS**2)
        ball = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        with np.errstate(divide="ignore"):
            floor = np.where(rays[..., 1] < 0, (FLOOR - origin[1]) / rays[..., 1], np.inf)
        depth = np.minimum(ball, floor)
        hdr = np.where((ball < floor)[..., None], RED, GREY).astype(np.float32)
        known = np.isfinite(depth)
        return rendered_view(hdr, known, np.where(known, depth, 0))


@pytest.fixture(scope="module")
def mesh():
    return proxy_mesh(BallOnFloor(), WorldTransform.identity(), resolution=72)


def test_vertices_lie_on_the_surfaces(mesh):
    ball = np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS)
    floor = np.abs(mesh.vertices[:, 1] - FLOOR)
    error = np.minimum(ball, floor)
    assert np.percentile(error, 90) < 0.5 * mesh.voxel and (ball < mesh.voxel).sum() > 500
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    level = np.abs(corners[:, :, 1] - FLOOR).max(1) < 0.3 * mesh.voxel
    assert (normals[level, 1] > 0).mean() > 0.99, "faces look outwards"
    on_top = np.linalg.norm(mesh.vertices - (0, RADIUS, 0), axis=1) < 0.3
    np.testing.assert_allclose(np.median(mesh.radiance[on_top], axis=0), RED, rtol=1e-3)


def test_a_ceiling_is_no_floor():
    """A level surface with normals along +Y hangs above, in photos' coordinates with -Y up, as COLMAP's."""
    run = BallOnFloor()
    run.up = UpDirection(np.array([0.0, -1.0, 0.0]), "gps")
    assert proxy_mesh(run, WorldTransform.identity(), resolution=24).ground is None
    mesh = proxy_mesh(run, WorldTransform.identity(), up="y", resolution=24)
    assert mesh.ground is not None, "the up direction that a user states counts, not the one of the photos"


@pytest.mark.parametrize("projection", ["equirectangular", "OPENCV_FISHEYE"])
def test_wide_cameras_show_the_same_surfaces(projection):
    """A panorama's pixels hold distances, in directions that no plane has."""
    run, width, distortion = BallOnFloor(), 256, (0.0,) * 4
    if projection == "equirectangular":
        width, distortion = 512, ()
    lens = {"width": width, "height": 256, "fx": 81.5, "fy": 81.5, "cx": width / 2, "cy": 128.0}
    lens |= {"projection": projection, "distortion": distortion}
    run.cameras = [Entry(each.name, each.split, replace(each.camera, **lens)) for each in run.cameras[::2]]
    region = Box(np.array([-1.0, -0.8, -1.0]), np.array([1.0, 0.8, 1.0]))
    mesh = proxy_mesh(run, WorldTransform.identity(), resolution=48, region=region)
    ball = np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS)
    error = np.minimum(ball, np.abs(mesh.vertices[:, 1] - FLOOR))
    assert np.percentile(error, 90) < 0.5 * mesh.voxel and (ball < mesh.voxel).sum() > 500


def test_a_crop_ends_at_its_box():
    """No side is a whole number of the longest one's voxels; the floor goes on behind all of them."""
    low, high = np.array([-0.9, -0.71, -0.83]), np.array([0.9, 0.53, 0.77])
    mesh = proxy_mesh(BallOnFloor(), WorldTransform.identity(), resolution=24, region=Box(low, high))
    assert (mesh.vertices >= low - 1e-6).all() and (mesh.vertices <= high + 1e-6).all()
    np.testing.assert_allclose(mesh.vertices.max(0)[[0, 2]], high[[0, 2]], atol=1e-6)
    ball = np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS)
    assert np.percentile(np.minimum(ball, np.abs(mesh.vertices[:, 1] - FLOOR)), 90) < 0.5 * mesh.voxel


def test_the_floor_is_found_and_a_tilt_of_it(mesh):
    assert mesh.ground is not None
    assert mesh.ground.height == pytest.approx(FLOOR, abs=0.3 * mesh.voxel) and mesh.ground.tilt < 0.5
    turn = np.radians(4)
    tilted = mesh.vertices @ np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    places = np.array([[0, 1.2, 2.6], [0, 1.2, -2.6]])
    ground = find_ground(tilted, mesh.faces, places, 2 * mesh.voxel)
    assert ground is not None and ground.tilt == pytest.approx(4, abs=1)
    assert find_ground(mesh.vertices, mesh.faces, places - (0, 5, 0), mesh.voxel) is None, "none above the cameras"


def test_depth_agrees_with_the_scene(mesh):
    run = BallOnFloor()
    camera = run.cameras[-1].camera.within(96)
    truth, measured = run.render(camera).depth.numpy(), mesh_depth(mesh, camera)
    both = (truth > 0) & (measured > 0)
    assert (measured > 0)[24:72, 24:72].mean() > 0.98
    assert np.median(np.abs(measured - truth)[both] / truth[both]) < 0.01


def test_openusd_holds_mesh_and_ground(tmp_path, logged):
    Usd, UsdGeom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    path = write_proxy_mesh(BallOnFloor(), tmp_path / "proxy.usdc", resolution=48, scale=2.0, up="y")
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and stage.GetDefaultPrim().GetName() == "World"
    proxy, ground = (UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}")) for name in ("Proxy", "Ground"))
    points = np.array(proxy.GetPointsAttr().Get())
    assert UsdGeom.Mesh.ValidateTopology(
        proxy.GetFaceVertexIndicesAttr().Get(), proxy.GetFaceVertexCountsAttr().Get(), len(points)
    )[0]
    assert len(proxy.GetDisplayColorPrimvar().Get()) == len(points)
    floor = np.array(ground.GetPointsAttr().Get())
    # The upright origin is where the cameras look, and meters are twice the scene's units.
    matrix = np.array(stage.GetDefaultPrim().GetAttribute("sehdr:worldMatrix").Get()).T
    np.testing.assert_allclose(floor[:, 1], (matrix @ [0, FLOOR, 0, 1])[1], atol=0.05)
    assert any("triangles" in line for line in logged) and any("off in the median" in line for line in logged)


def test_a_floor_that_is_not_level_comes_with_the_option_that_levels_it(tmp_path, logged):
    turn = np.radians(6)
    up = f"{np.sin(turn):.6f},{np.cos(turn):.6f},0"
    write_proxy_mesh(BallOnFloor(), tmp_path / "tilted.obj", resolution=48, up=up)
    [line] = [line for line in logged if line.startswith("ground")]
    measured = np.array([float(value) for value in line.split("--up=")[1].split(" ")[0].split(",")])
    np.testing.assert_allclose(measured, [0, 1, 0], atol=0.02)
    logged.clear()
    write_proxy_mesh(BallOnFloor(), tmp_path / "level.obj", resolution=48, up=",".join(map(str, measured)))
    [line] = [line for line in logged if line.startswith("ground")]
    assert "--up" not in line


def test_a_floor_far_from_up_by_the_photos_is_not_levelled(tmp_path, logged):
    """A wall counts as the floor where --up is wrong; advice that levels the wall would be wrong, too."""
    run, turn = BallOnFloor(), np.radians(6)
    run.up = UpDirection(np.array([1.0, 0.0, 0.0]), "gps")
    write_proxy_mesh(run, tmp_path / "wall.obj", resolution=48, up=f"{np.sin(turn):.6f},{np.cos(turn):.6f},0")
    [line] = [line for line in logged if line.startswith("ground")]
    assert "--up=" not in line
    assert "90 degrees from up by the photos: if this is a wall or a ceiling, leave --up out" in line


def test_stairs_are_no_floor():
    """Their steps are level, and a plane through them is not."""
    corners = [(0.0, 0, 0), (0, 0, 1), (0.2, 0, 1), (0.2, 0, 0)]
    steps = np.concatenate([np.add(corners, (0.2 * i, 0.1 * i, 0)) for i in range(5)])
    faces = np.concatenate([4 * i + np.array([(0, 1, 2), (0, 2, 3)]) for i in range(5)])
    cameras = np.array([[0.0, 5, 0]])
    assert find_ground(steps, faces, cameras, 0.1) is None
    floor = find_ground(steps * (1, 0.1, 1), faces, cameras, 0.01)
    assert floor is not None and floor.tilt == pytest.approx(2.9, abs=0.3)


class LampOnFloor(BallOnFloor):
    """The same, whose ball is a lamp: Gaussians on its surface are a light."""

    def __init__(self):
        super().__init__()
        steps = np.arange(300) + 0.5
        height, angle = 1 - 2 * steps / 300, np.pi * (1 + np.sqrt(5)) * steps
        ring = np.sqrt(1 - height**2)
        means = RADIUS * np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1)
        self.field = field_of(splats(means, np.full(300, 0.9), scale=0.04))
        self.clipped_share = lambda: torch.ones(300)

    def find_lights(self):
        shape = LightShape("sphere", np.zeros(3), np.eye(3), (2 * RADIUS, 2 * RADIUS))
        return [Light(shape, np.full(3, 5.0), np.ones(3), None, 1.0, torch.arange(300))]


def test_a_lamp_of_the_scene_lights_the_floor_of_its_mesh(tmp_path, logged):
    """Mitsuba gives it the light that a plane gets; a mesh that contains the lamp blocks most of it."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    lamp = {"type": "sphere", "radius": RADIUS, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}}
    to_world = mi.ScalarTransform4f().look_at([0, 4, 0], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 60, "to_world": to_world, "film": film}
    plain = {"type": "scene", "integrator": {"type": "direct"}, "sensor": sensor, "lamp": lamp}
    material = {"type": "twosided", "inside": {"type": "diffuse"}}

    def floor_by(shape):
        picture = np.array(mi.render(mi.load_dict(plain | {"floor": shape | {"bsdf": material}}), spp=32)).mean(2)
        y, x = np.mgrid[:32, :32] - 15.5
        distance = np.hypot(x, y) * 4.6 * np.tan(np.pi / 6) / 16  # From the axis, on the floor
        return picture[(distance > 1.3 * RADIUS) & (distance < 1.5)]

    turned = mi.ScalarTransform4f().translate([0, FLOOR, 0]).rotate([1, 0, 0], -90).scale(20)
    truth = floor_by({"type": "rectangle", "to_world": turned})
    path = write_proxy_mesh(LampOnFloor(), tmp_path / "lamp.obj", resolution=64, axes="scene")
    assert "triangles at the scene's lights (1), whose" in "".join(logged)
    mesh = {"type": "obj", "filename": str(path), "face_normals": True}
    assert np.median(floor_by(mesh) / truth) == pytest.approx(1, abs=0.03)
    whole = write_proxy_mesh(BallOnFloor(), tmp_path / "ball.obj", resolution=64, axes="scene")
    assert np.median(floor_by(mesh | {"filename": str(whole)}) / truth) < 0.5


@pytest.mark.parametrize(
    "name, options, message",
    [
        ("proxy.fbx", {}, r"not written as .fbx; use one of .obj, .usda, .usdc"),
        ("proxy.obj", {"resolution": 4}, "resolution 4 is not between 16 and 512"),
        ("proxy.obj", {"crop": "cube:1"}, "is not box:"),
        ("proxy.obj", {"crop": "sphere:50,50,50,1", "axes": "scene", "resolution": 24}, "no surface to mesh"),
    ],
)
def test_bad_requests_are_one_line(name, options, message, tmp_path):
    with pytest.raises(SehdrError, match=message):
        write_proxy_mesh(BallOnFloor(), tmp_path / name, **options)
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize("name", ["a.obj", "a.usdc"])
def test_map_coordinates_that_a_mesh_cannot_hold_are_named(name, tmp_path, logged):
    if name == "a.usdc":
        pytest.importorskip("pxr")
    run = BallOnFloor()
    run.world_matrix = np.eye(4)
    run.world_matrix[1, 3] = -5.4e6  # From the photos' coordinates to the scene's
    write_proxy_mesh(run, tmp_path / name, resolution=24)
    assert not any("too large for its numbers" in line for line in logged)
    write_proxy_mesh(run, tmp_path / name, resolution=24, axes="scene", overwrite=True)
    assert any(f"{name}: coordinates up to 5.4e+06 are too large for its numbers" in line for line in logged)


def test_a_scene_without_cameras_is_refused():
    run = BallOnFloor()
    run.cameras = []
    with pytest.raises(SehdrError, match="no training cameras"):
        proxy_mesh(run, WorldTransform.identity())


def test_files_are_not_replaced(tmp_path):
    (tmp_path / "proxy.obj").write_text("mine")
    with pytest.raises(InputError):
        write_proxy_mesh(BallOnFloor(), tmp_path / "proxy.obj")


def test_a_full_disk_ends_in_one_line(tmp_path):
    pytest.importorskip("pxr")
    with pytest.raises(SehdrError, match="proxy.usdc: cannot be written") as caught, full_disk():
        write_proxy_mesh(BallOnFloor(), tmp_path / "proxy.usdc", resolution=48)
    assert "\n" not in str(caught.value) and not any(tmp_path.iterdir())
