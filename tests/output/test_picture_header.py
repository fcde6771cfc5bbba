"""Files state how their coordinates, white and cameras follow from the photos."""

import json

import numpy as np
import pytest

from sehdr_warp.model.baking import field_of
from sehdr_warp.output.cameras.selection import select_cameras
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.lighting.environment_map import write_environment_map
from sehdr_warp.output.render_views import render_views
from sehdr_warp.output.world_transform import WorldTransform, photos_to_scene, world_transform
from sehdr_warp.runs.run import Splats, load_splats
from sehdr_warp.scene import Camera
from tests.splats.samples import gaussians

from .helpers import AnalyticRun, Entry, camera, read_exr


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
