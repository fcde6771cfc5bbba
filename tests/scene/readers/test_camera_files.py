import json

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_cameras, look_at
from tests.make_scenes import load, write_blender

POSE = look_at((1.0, 2.0, 3.0), (0.0, 0.5, 0.0))
CAMERA = {"width": 8, "height": 8, "fx": 9, "fy": 9, "cx": 4, "cy": 4, "world_to_camera": POSE.tolist()}


def nerfstudio(folder, world_to_camera):
    matrix = np.linalg.inv(world_to_camera) @ np.diag([1.0, -1, -1, 1])
    entry = {"camera_to_world": matrix.ravel().tolist(), "fov": 50, "aspect": 1.5}
    values = {"render_width": 60, "render_height": 40, "camera_path": [entry]}
    (folder / "camera_path.json").write_text(json.dumps(values))
    return load_cameras(folder / "camera_path.json")[0][1]


@pytest.mark.parametrize("kind", ["fisheye", "equirectangular"])
def test_nerfstudio_paths_of_other_projections_are_refused(tmp_path, kind):
    nerfstudio(tmp_path, POSE)
    values = json.loads((tmp_path / "camera_path.json").read_text())
    (tmp_path / "camera_path.json").write_text(json.dumps(values | {"camera_type": kind}))
    with pytest.raises(InputError, match=f"camera 0 has camera_type '{kind}'; use perspective cameras"):
        load_cameras(tmp_path / "camera_path.json")


def test_nerfstudio_paths_come_back_from_the_dataparsers_space(tmp_path, logged):
    np.testing.assert_allclose(nerfstudio(tmp_path, POSE).world_to_camera, POSE, atol=1e-9)
    assert "no dataparser_transforms.json next to it" in logged[0]
    # As nerfstudio moves poses: rotated and shifted, then places scaled.
    turn, scale = look_at((0.3, -1.0, 0.2), (1.0, 0.0, 0.0)), 0.25
    moved = turn @ np.linalg.inv(POSE)
    moved[:3, 3] *= scale
    similarity = {"transform": turn[:3].tolist(), "scale": scale}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(similarity))
    np.testing.assert_allclose(nerfstudio(tmp_path, np.linalg.inv(moved)).world_to_camera, POSE, atol=1e-9)
    (tmp_path / "dataparser_transforms.json").write_text("{}")
    with pytest.raises(InputError, match="no usable transform and scale"):
        nerfstudio(tmp_path, POSE)


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        *(("width", value, "cannot be used.*width") for value in (8.5, True, "8")),
        ("width", None, "width is null, not a whole number"),
        ("fx", [1, 2], "fx is a list of 2, not a number"),
        ("fy", True, "fy is true, not a number"),
        ("name", None, "name is null, not a text"),
        ("distortion", 3, "distortion is 3, not one list of numbers"),
        *((name, 1e300, f"cannot be used.*{name}") for name in ("cx", "world_to_camera")),
        ("fx", float("nan"), "cannot be used.*fx"),
        ("name", "../../x", r"name '../../x' cannot name a file"),
    ],
)
def test_values_that_cannot_be_are_refused(tmp_path, name, value, problem):
    moved = [[1, 0, 0, value], *np.eye(4).tolist()[1:]]
    values = CAMERA | {name: moved if name == "world_to_camera" else value}
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": [values]}))
    with pytest.raises(InputError, match=f"camera .*{problem}"):
        load_cameras(tmp_path / "cameras.json")


def test_a_colmap_model_is_a_camera_file(tmp_path):
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 64 48 50 51 32 24\n")
    (model / "images.txt").write_text("1 1 0 0 0 0.5 0 2 1 photo_2.jpg\n\n2 1 0 0 0 0 0 2 1 photo_1.jpg\n\n")
    named = load_cameras(tmp_path)
    assert [name for name, _ in named] == ["photo_1", "photo_2"] and named[0][1].fy == 51
    with pytest.raises(InputError, match="holds no COLMAP model"):
        load_cameras(model)


def test_a_splat_is_no_camera_file(tmp_path):
    path = tmp_path / "room.PLY"
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\n\xff")
    with pytest.raises(InputError, match=r"room.PLY: holds Gaussians or points, not cameras; give a camera file"):
        load_cameras(path)


@pytest.mark.parametrize(("suffix", "name"), [(".abc", "Alembic"), (".FBX", "FBX")])
def test_camera_files_of_other_programs_get_a_line_on_what_to_export(tmp_path, suffix, name):
    path = tmp_path / f"shot{suffix}"
    path.write_bytes(b"Ogawa\xff\x00")
    with pytest.raises(InputError, match=f"shot{suffix}: {name} files are not read; export the camera as OpenUSD"):
        load_cameras(path)


@pytest.mark.parametrize(
    "content, message",
    [
        ("[]", "no cameras"),
        ("{", "not valid JSON"),
        ("[" * 100000, "not valid JSON"),
        ("{}", "none of cameras"),
        ('{"cameras": []}', "no cameras"),
        ('{"cameras": [{"width": 4}]}', "has no height"),
        ('{"cameras": [5]}', "camera 0 is 5, not an object; state"),
        ("[1, 2]", "camera 0 is 1, not an object; state its size, focal lengths and pose by name"),
        ('["x"]', "camera 0 is 'x', not an object; state"),
        ("[[[1, 2]]]", "camera 0 is a list of 1, not an object; state"),
        ("3", "holds 3, not an object; export"),
        ("null", "holds null, not an object; export"),
        ('"x"', "holds 'x', not an object; export"),
        (
            '[{"img_name": "a", "width": 4, "height": 4, "rotation": [[1, 0], [0, 1]]}]',
            "rotation holds 4 numbers, not 3 x 3",
        ),
        (
            json.dumps({"cameras": [CAMERA | {"world_to_camera": [[1, 2], [3]]}]}),
            "world_to_camera holds 3 numbers, not 4 x 4",
        ),
        (
            json.dumps({"cameras": [CAMERA | {"world_to_camera": [[1, 2, 3, "x"]] * 4}]}),
            "world_to_camera holds 'x', not 4 x 4",
        ),
        (json.dumps({"cameras": [CAMERA | {"width": 65_000, "height": 65_000}]}), "is 65000 x 65000; use sizes"),
        ('{"camera_path": [{}], "render_width": 4, "render_height": 4}', "has no fov"),
    ],
)
def test_bad_camera_files_are_refused(tmp_path, content, message):
    (tmp_path / "c.json").write_text(content)
    with pytest.raises(InputError, match=message):
        load_cameras(tmp_path / "c.json")


def test_cameras_from_every_kind_of_file(tmp_path):
    write_blender(tmp_path, w=40, h=30)
    scene = load(tmp_path, cache=tmp_path / "cache")
    expected = scene.views[2].camera
    own = tmp_path / "cameras.json"
    own.write_text(json.dumps({"cameras": [{"name": "a", **expected.to_dict()}, {"name": "b", **expected.to_dict()}]}))
    matrix = expected.camera_to_world.copy()
    matrix[:3, 1:3] *= -1
    path = tmp_path / "camera_path.json"
    fov = float(np.degrees(2 * np.arctan(15 / expected.fy)))
    entry = {"camera_to_world": matrix.ravel().tolist(), "fov": fov, "aspect": 1}
    path.write_text(json.dumps({"render_width": 40, "render_height": 30, "camera_path": [entry]}))
    for file, index, name in ((own, 1, "b"), (path, 0, "0000"), (tmp_path / "transforms.json", 2, "r_2")):
        read_name, camera = load_cameras(file)[index]
        assert read_name == name
        np.testing.assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-12)
        np.testing.assert_allclose(camera.intrinsics, expected.intrinsics, rtol=1e-12)
