"""OpenSfM's reconstructions, written as OpenSfM does."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene
from tests.make_scenes import edited_json

SIZES = {"spherical": (64, 32), "perspective": (48, 36), "fisheye": (48, 48)}


def write(folder, kind="spherical", count=4, size=None, **changes):
    width, height = size or SIZES.get(kind, (48, 36))
    camera = {"projection_type": kind, "width": width, "height": height, "focal": 0.3 if kind == "fisheye" else 0.9}
    shots = {}
    (folder / "images").mkdir(exist_ok=True, parents=True)
    for i in range(count):
        pixels = np.random.default_rng(i).integers(20, 230, (height, width, 3), np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"{i}.jpg")
        shots[f"{i}.jpg"] = {"camera": "v2", "rotation": [0.1 * i, 0.2, 0], "translation": [i, 0, 1]}
    points = {"7": {"coordinates": [1, 2, 3], "color": [255, 0, 51]}}
    model = {"cameras": {"v2": camera}, "shots": shots, "points": points} | changes
    (folder / "reconstruction.json").write_text(json.dumps([{"cameras": {}, "shots": {}}, model]))
    return folder


@pytest.mark.parametrize("kind, projection", [
    ("spherical", "equirectangular"), ("perspective", "pinhole"), ("fisheye", "RADIAL_FISHEYE"),
])  # fmt: skip
def test_poses_points_and_projections(tmp_path, kind, projection):
    scene = load_scene(write(tmp_path, kind), response="srgb")
    assert scene.format == "opensfm" and len(scene.views) == 4
    camera = scene.views[2].camera
    assert camera.projection == projection
    np.testing.assert_allclose(camera.world_to_camera[:3, :3], Rotation.from_rotvec([0.2, 0.2, 0]).as_matrix())
    np.testing.assert_allclose(camera.world_to_camera[:3, 3], [2, 0, 1])
    np.testing.assert_allclose(scene.points, [[1, 2, 3]])
    np.testing.assert_allclose(scene.point_colors, [[1, 0, 0.2]], atol=1e-6)
    if kind == "perspective":
        np.testing.assert_allclose(camera.intrinsics, [0.9 * 48, 0.9 * 48, 24, 18])
    assert any("holds 2 reconstructions" in note for note in scene.notes)


def test_what_cannot_be_used_is_named(tmp_path):
    folder = write(tmp_path)

    def refused(match, text):
        (folder / "reconstruction.json").write_text(text)
        with pytest.raises(InputError, match=match):
            load_scene(folder, response="srgb")

    with edited_json(folder / "reconstruction.json") as whole:
        refused("is not a list of reconstructions", "{}")
        whole[1]["cameras"]["v2"]["projection_type"] = "dual"
        refused("projection_type 'dual', which is not supported", json.dumps(whole))
        whole[1]["cameras"]["v2"]["projection_type"] = "spherical"
        whole[1]["shots"]["1.jpg"]["rotation"] = [0, "x", 1]
    scene = load_scene(folder, response="srgb")
    assert len(scene.views) == 3 and "pose of '1.jpg' cannot be used" in scene.notes[0]
    for name in ("0.jpg", "2.jpg"):
        whole[1]["shots"][name]["rotation"] = [0, "x", 1]
    refused("pose of '0.jpg' cannot be used", json.dumps(whole))
    refused("holds no reconstruction; reconstruct again", "[]")
    whole[1]["shots"]["1.jpg"] = {"camera": "other", "rotation": [0, 0, 0], "translation": [0, 0, 0]}
    refused("shot '1.jpg' has no camera", json.dumps(whole))


def test_pixels_count_as_they_are_stored(tmp_path):
    """OpenSfM ignores the EXIF orientation, with which phones mark portrait photos."""
    folder = write(tmp_path, "perspective")
    for photo in sorted((folder / "images").iterdir()):
        exif = Image.Exif()
        exif[0x0112] = 6
        with Image.open(photo) as image:
            image.save(photo, exif=exif)
    camera = load_scene(folder, response="srgb").views[0].camera
    assert (camera.width, camera.height) == (48, 36)


@pytest.mark.parametrize("images", ["images", "opensfm/images"])
def test_projects_of_opendronemap(tmp_path, images):
    """OpenSplat issue 126: the reconstruction lies in opensfm/, the photos beside it or in it, in other letters."""
    write(tmp_path, "perspective")
    (tmp_path / "opensfm").mkdir()
    (tmp_path / "reconstruction.json").rename(tmp_path / "opensfm" / "reconstruction.json")
    if images != "images":
        (tmp_path / "images").rename(tmp_path / images)
    (tmp_path / images / "1.jpg").rename(tmp_path / images / "1.JPG")
    assert len(load_scene(tmp_path, response="srgb").views) == 4
    assert load_scene(write(tmp_path / "above" / "set").parent, response="srgb").format == "opensfm"


def test_colmap_panoramas(tmp_path):
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (tmp_path / "images").mkdir()
    (model / "cameras.txt").write_text("1 EQUIRECTANGULAR 64 32 64 32\n")
    lines = []
    for i in range(4):
        Image.fromarray(np.random.default_rng(i).integers(20, 230, (32, 64, 3), np.uint8)).save(
            tmp_path / "images" / f"{i}.png"
        )
        lines.append(f"{i + 1} 1 0 0 0 {i} 0 0 1 {i}.png\n\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text("1 1 2 3 255 0 0 0.5\n")
    scene = load_scene(tmp_path, response="srgb")
    assert scene.format == "colmap" and {view.camera.projection for view in scene.views} == {"equirectangular"}
    np.testing.assert_allclose(scene.views[3].camera.position, [-3, 0, 0])
