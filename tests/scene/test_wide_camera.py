"""Panoramas and wide fisheye lenses: where their pixels look, what they count, and how they are loaded."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene import load_scene, look_at
from sehdr_warp.scene.camera import Camera
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.types import View, codes_of
from sehdr_warp.scene.wide_camera import (
    faces_of,
    perspective_cameras,
    perspective_views,
    pixel_directions,
    pixels_of_directions,
    solid_angles,
    surface_points,
)

WIDTH, HEIGHT = 128, 64
FISHEYE = (40.0, 41.0, 64.0, 48.0, 0.02, -0.01, 0.003, 0.0)


def panorama(pose=None):
    return Lens("EQUIRECTANGULAR", WIDTH, HEIGHT, (WIDTH, HEIGHT), "test").camera(np.eye(4) if pose is None else pose)


def fisheye():
    return Lens("OPENCV_FISHEYE", 128, 96, FISHEYE, "test").camera(np.eye(4))


def colored(camera):
    """A view whose colors are the directions of its pixels, world axes."""
    along = np.nan_to_num(pixel_directions(camera)) @ camera.world_to_camera[:3, :3]
    return View("a", codes_of((along + 1) / 2, 16), camera, 1.0, "train", solid_angles(camera))


@pytest.mark.parametrize("camera", [panorama(), fisheye()], ids=["panorama", "fisheye"])
def test_pixels_and_directions_are_inverse(camera):
    places = pixels_of_directions(pixel_directions(camera), camera)
    inside = np.isfinite(places).all(2)
    assert inside.mean() > 0.95
    np.testing.assert_allclose(
        places[inside], np.stack(np.mgrid[: camera.height, : camera.width], 2)[inside], atol=1e-4
    )


@pytest.mark.parametrize("camera", [panorama(), fisheye()], ids=["panorama", "fisheye"])
def test_depths_of_wide_cameras_are_distances_and_those_of_pinholes_lie_along_the_axis(camera):
    camera = replace(camera, world_to_camera=look_at((1, 2, 3), (0, 0, 1)))
    depth = np.full((camera.height, camera.width), 2.5)
    offsets = surface_points(camera, depth) - camera.position
    inside = np.isfinite(pixel_directions(camera)).all(2)
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=2), np.where(inside, 2.5, 0))
    np.testing.assert_allclose(
        offsets[inside], 2.5 * (pixel_directions(camera) @ camera.world_to_camera[:3, :3])[inside]
    )
    pinhole = replace(camera, projection="pinhole", distortion=())
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    expected = pinhole.unproject(x.ravel(), y.ravel(), depth.ravel()).reshape(offsets.shape)
    np.testing.assert_allclose(surface_points(pinhole, depth), expected)


def test_a_lens_shows_nothing_beyond_its_widest_angle():
    """theta - 0.1 theta^3 is largest at 105 degrees and 0 again behind the camera."""
    camera = Camera(200, 200, 60.0, 60.0, 100.0, 100.0, np.eye(4), "SIMPLE_RADIAL_FISHEYE", (-0.1,))
    angles = np.radians([0, 60, 104, 106, 150, 179, 180])
    directions = np.stack([np.sin(angles), np.zeros(7), np.cos(angles)], 1)
    visible = np.isfinite(pixels_of_directions(directions, camera)).all(1)
    assert visible.tolist() == [True, True, True, False, False, False, False]
    assert len(faces_of(colored(camera))) == 5, "none of what is behind"


def test_directions_are_those_of_colmap():
    pycolmap = pytest.importorskip("pycolmap")
    for camera, params in ((panorama(), [WIDTH, HEIGHT]), (fisheye(), FISHEYE)):
        model = "EQUIRECTANGULAR" if camera.projection == "equirectangular" else camera.projection
        theirs = pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=list(params))
        column, row = np.meshgrid(np.arange(52, 76) + 0.5, np.arange(26, 38) + 0.5)
        expected = theirs.cam_from_img(np.stack([column.ravel(), row.ravel()], 1))
        ours = pixel_directions(camera)[26:38, 52:76].reshape(-1, 3)
        np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], expected, atol=1e-6)


def test_solid_angles_add_up_to_the_sphere():
    camera = panorama()
    weights = solid_angles(camera)
    assert weights.max() == pytest.approx(1) and weights[0, 0] < 0.05
    # A pixel at the equator covers (2 pi / W)^2.
    assert weights.sum() * (2 * np.pi / WIDTH) ** 2 == pytest.approx(4 * np.pi, rel=2e-3)


@pytest.mark.parametrize("camera, count", [(panorama(), 6), (fisheye(), 1)], ids=["panorama", "fisheye"])
def test_cut_views_show_the_same_directions(camera, count):
    faces = faces_of(colored(camera))
    assert len(faces) >= count and all(face.camera.is_pinhole for face in faces)
    cameras = perspective_cameras([camera])
    assert len(cameras) == len(faces) and all(coarse.width == 64 for coarse in cameras)
    for coarse, face in zip(cameras, faces, strict=True):
        np.testing.assert_allclose(coarse.resized(*face.image.shape[1::-1]).intrinsics, face.camera.intrinsics)
        np.testing.assert_array_equal(coarse.world_to_camera, face.camera.world_to_camera)
    for face in faces:
        along = pixel_directions(face.camera) @ face.camera.world_to_camera[:3, :3]
        inside = np.ones(along.shape[:2], bool) if face.mask is None else face.mask > 0.99
        assert np.abs(face.image - (along + 1) / 2)[inside].max() < 0.02, face.name


def test_a_mask_of_a_panorama_reaches_its_cut_views():
    view = colored(panorama())
    masked = view.mask.copy()
    masked[:, : WIDTH // 2] = 0
    faces = {face.name: face for face in perspective_views([View("a", view.codes, view.camera, 1.0, "train", masked)])}
    # The left half of the picture is what lies to the left of the camera's axis.
    assert faces["a//1"].mask is None or faces["a//1"].mask.mean() > 0.95
    assert faces["a//3"].mask.mean() < 0.05 and 0.4 < faces["a//0"].mask.mean() < 0.6


def test_narrow_fisheye_photos_are_undistorted():
    narrow = Lens("OPENCV_FISHEYE", 128, 96, (120.0, 120.0, *FISHEYE[2:]), "test")
    assert narrow.projection == "pinhole" and not narrow.is_pinhole
    assert fisheye().projection == "OPENCV_FISHEYE"


def test_cameras_are_written_and_read():
    for camera in (panorama(), fisheye()):
        again = Camera.from_dict(json.loads(json.dumps(camera.to_dict())))
        assert (again.projection, again.distortion) == (camera.projection, camera.distortion)
    half = fisheye().resized(64, 48)
    np.testing.assert_allclose(
        pixel_directions(half)[10, 10], pixel_directions(fisheye())[20:22, 20:22].mean((0, 1)), atol=2e-3
    )


def write_set(folder, lens, size=(WIDTH, HEIGHT), mask=None):
    frames = []
    for i in range(4):
        pixels = np.random.default_rng(i).integers(20, 230, (size[1], size[0], 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{i}.png")
        frames.append({"file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist()})
        if mask is not None:
            Image.fromarray(mask).save(folder / f"mask_{i}.png")
            frames[-1]["mask_path"] = f"mask_{i}.png"
    (folder / "transforms.json").write_text(json.dumps({"w": size[0], "h": size[1], "frames": frames} | lens))
    return folder


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "equirectangular", "SPHERICAL"])
def test_panoramas_of_nerfstudio_are_loaded_whole(tmp_path, model):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[HEIGHT * 3 // 4 :] = 0  # The photographer
    scene = load_scene(write_set(tmp_path, {"camera_model": model}, mask=mask), response="srgb", max_size=64)
    view = scene.views[0]
    assert view.camera.projection == "equirectangular" and view.codes.shape == (32, 64, 3)
    np.testing.assert_allclose(view.mask[:24], solid_angles(view.camera)[:24], atol=1e-6)
    assert (view.mask[24:] == 0).all()
