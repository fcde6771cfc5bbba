"""transforms.json in its dialects, HDR-NeRF's two layouts, LLFF, and cameras to render from."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_cameras
from sehdr_warp.scene.dataparser import reinhard_gamma
from sehdr_warp.scene.readers.transforms import read_transforms
from tests.make_scenes import (
    arc_poses,
    edited_json,
    load,
    pattern,
    room_views,
    write_blender,
    write_colmap,
    write_llff,
    write_ply,
    write_room,
)


def _edit(folder, **fields):
    path = folder / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def test_blender_poses_become_opencv(tmp_path):
    write_blender(tmp_path, 9, ply_file_path="cloud.ply")
    write_ply(tmp_path / "cloud.ply", [(0, 0, 0), (1, 2, 3)], [(255, 0, 0), (0, 0, 51)])
    scene = load(tmp_path)
    assert [view.name for view in scene.test_views] == ["r_4"] and scene.format == "transforms"
    for view, pose in zip(scene.views, arc_poses(9), strict=True):
        np.testing.assert_allclose(view.camera.world_to_camera, pose, atol=1e-12)
        assert view.camera.fx == view.camera.fy == pytest.approx(20 / np.tan(0.4)) and view.camera.cx == 20
    np.testing.assert_array_equal(scene.points, [[0, 0, 0], [1, 2, 3]])
    np.testing.assert_allclose(scene.point_colors, [[1, 0, 0], [0, 0, 0.2]], atol=1e-6)


def test_transparent_pixels_show_black_light(tmp_path):
    write_blender(tmp_path, rgba=True, camera_angle_x=0.7)
    view = load(tmp_path, cache=tmp_path / "cache").views[0]
    assert view.image[:, :20].max() == 0 and view.mask is None
    note = "transparency: 6 of 6 photos have transparent pixels, which count as black light"
    assert note in load(tmp_path, cache=tmp_path / "cache").notes
    np.testing.assert_allclose(view.image[:, 20:], pattern(40, 30, 0)[:, 20:] / 255, atol=1e-6)


def test_frame_values_win_over_the_files(tmp_path):
    write_blender(tmp_path, fl_x=50.0, cx=18.0, camera_model="OPENCV", k1=0.0)
    values = json.loads((tmp_path / "transforms.json").read_text())
    values["frames"][1] |= {"fl_x": 60.0, "fl_y": 61.0, "exposure_time": 0.5, "split": "test", "mask_path": "mask.png"}
    for i in (0, 2, 3, 4, 5):
        values["frames"][i] |= {"exposure_time": 0.25, "split": "train"}
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    Image.fromarray(np.eye(30, 40, dtype=np.uint8) * 255).save(tmp_path / "mask.png")
    scene = load(tmp_path)
    first, second = scene.views[:2]
    assert tuple(first.camera.intrinsics) == (50, 50, 18, 15) and tuple(second.camera.intrinsics) == (60, 61, 18, 15)
    assert (first.exposure_time, second.exposure_time) == (0.25, 0.5) and scene.exposure_times_known
    assert scene.test_views == (second,) and any("exposures differ" in note for note in scene.notes)
    np.testing.assert_array_equal(second.mask, np.eye(30, 40))


@pytest.mark.parametrize(
    "fields, model, bent",
    [
        (
            {"camera_model": "FULL_OPENCV", "p1": 1e-3} | {f"k{n}": n / 10 for n in range(1, 7)},
            "FULL_OPENCV",
            (0.1, 0.2, 1e-3, 0, 0.3, 0.4, 0.5, 0.6),
        ),
        ({"k1": 0.1, "k3": 0.3}, "FULL_OPENCV", (0.1, 0, 0, 0, 0.3, 0, 0, 0)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "OPENCV_FISHEYE", (0.1, 0, 0, 0.4)),
        ({"camera_model": "SIMPLE_RADIAL_FISHEYE", "k1": 0.1}, "OPENCV_FISHEYE", (0.1, 0, 0, 0)),
        ({"is_fisheye": True, "k1": 0.1, "k2": 0.2}, "OPENCV_FISHEYE", (0.1, 0.2, 0, 0)),
    ],
)
def test_distortion_by_camera_model(tmp_path, fields, model, bent):
    """nerfstudio issues 3355 and 3611, instant-ngp pull request 1147: k4 to k6 differ between programs."""
    write_blender(tmp_path, fl_x=50.0, **fields)
    lens = read_transforms(tmp_path).records[0].lens
    assert lens.model == model and lens.params[4:] == pytest.approx(bent)


def test_a_lens_that_leaves_little_of_the_photos_is_named(tmp_path):
    write_blender(tmp_path, 6, size=(150, 200), fl_x=343.0, fl_y=975.0, k1=46.6, k2=-3690.0)
    note = "lens: undistorted, 6 of 6 photos show at most "
    assert any(line.startswith(note) for line in load(tmp_path).notes)
    _edit(tmp_path, k1=-0.3, k2=0.1)
    assert not any(line.startswith(note) for line in load(tmp_path).notes)


@pytest.mark.parametrize("name", ["k4", "k5", "k6"])
def test_distortion_whose_meaning_is_open_is_refused(tmp_path, name):
    write_blender(tmp_path, **{"k1": 0.1, name: 0.2})
    with pytest.raises(InputError, match=f"{name} = 0.2 of camera_model OPENCV has no one meaning; state camera_model"):
        load(tmp_path)


def test_intrinsics_of_frames_alone_and_in_degrees(tmp_path):
    """LichtFeld-Studio pull request 1608, nerfstudio issue 737."""
    write_blender(tmp_path, exposure_time=0.25)
    with edited_json(tmp_path / "transforms.json") as values:
        del values["camera_angle_x"]
        for frame in values["frames"]:
            frame |= {"x_fov": np.degrees(0.8), "w": 40, "h": 30, "cx": 19.0}
    view = load(tmp_path).views[0]
    assert view.camera.fx == view.camera.fy == pytest.approx(20 / np.tan(0.4)) and view.camera.cx == 19
    assert view.exposure_time == 0.25


def test_a_focal_length_or_angle_counts_beside_a_matrix_of_another_size(tmp_path):
    matrix = [[0.5, 0, 0.5], [0, 0.6, 0.5], [0, 0, 1]]
    write_blender(tmp_path, fl_x=60.0, K=matrix)
    assert tuple(load(tmp_path).views[0].camera.intrinsics) == (60, 60, 20, 15)
    write_blender(tmp_path, K=matrix)
    assert load(tmp_path).views[0].camera.fx == pytest.approx(20 / np.tan(0.4))
    write_blender(tmp_path, camera_angle_x=None, K=[[[1], 0, 0], [0, 1, 0], [0, 0, 1]])
    with pytest.raises(InputError, match="no focal length"):
        load(tmp_path)


def test_photos_of_another_folder_do_not_stand_for_missing_ones(tmp_path):
    write_blender(tmp_path)
    values = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "images").rename(tmp_path / "train")
    with pytest.raises(InputError, match="image file not found"):
        read_transforms(tmp_path)
    (tmp_path / "transforms.json").unlink()
    for split in ("train", "test"):
        frames = [frame | {"file_path": f"./{split}/r_{i}"} for i, frame in enumerate(values["frames"])]
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(values | {"frames": frames}))
    dataset = read_transforms(tmp_path)
    assert {record.split for record in dataset.records} == {"train"} and len(dataset.records) == 6
    assert any(note.startswith("6 of 12 frames have no photo") for note in dataset.notes)


def test_nerfstudio_points_move_with_the_poses(tmp_path):
    write_blender(tmp_path, applied_transform=[[0, 1, 0, 5], [1, 0, 0, 0], [0, 0, -1, 0]], applied_scale=0.5)
    write_colmap(tmp_path / "colmap")
    expected = sorted([(-i / 3 + 5) / 2, i / 2, -0.125] for i in range(5))
    np.testing.assert_allclose(sorted(load(tmp_path).points.tolist()), expected)


def test_distortion_as_a_list(tmp_path):
    bent = {"k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}
    write_blender(tmp_path / "a", 2, **bent)
    write_blender(tmp_path / "b", 2)
    frames = json.loads((tmp_path / "b" / "transforms.json").read_text())["frames"]
    params = [bent.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")]
    _edit(tmp_path / "b", frames=[frame | {"distortion_params": params} for frame in frames])
    lenses = [read_transforms(tmp_path / name).records[1].lens for name in "ab"]
    assert lenses[0].params == lenses[1].params and lenses[0].model == "OPENCV"


def test_poses_of_mitsuba_have_x_to_the_left_and_z_ahead(tmp_path):
    write_blender(tmp_path, 3)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    for frame in frames:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1, 1, -1, 1])).tolist()
    _edit(tmp_path, frames=frames, from_mitsuba=True)
    for record, pose in zip(read_transforms(tmp_path).records, arc_poses(3), strict=True):
        np.testing.assert_allclose(record.world_to_camera, pose, atol=1e-12)


def test_sets_of_which_reduced_images_alone_are_public(tmp_path):
    write_blender(tmp_path, 3, w=160, h=120, fl_x=160)
    (tmp_path / "images").rename(tmp_path / "images_4")
    assert [record.image.parent.name for record in read_transforms(tmp_path).records] == ["images_4"] * 3
    assert [view.camera.fx for view in load(tmp_path, holdout=0).views] == [40.0] * 3


def test_names_of_web_addresses(tmp_path):
    write_blender(tmp_path, 3)
    (tmp_path / "images" / "r_0.png").rename(tmp_path / "images" / "r 0.png")
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    _edit(tmp_path, frames=[frames[0] | {"file_path": "images/r%200.png"}, *frames[1:]])
    assert read_transforms(tmp_path).records[0].image.name == "r 0.png"


def test_split_files_beside_transforms_json_divide_its_frames(tmp_path):
    write_blender(tmp_path, 9)
    values, test = json.loads((tmp_path / "transforms.json").read_text()), tmp_path / "transforms_test.json"
    frames = values["frames"]
    (tmp_path / "transforms_train.json").write_text(json.dumps(values | {"frames": frames[:6]}))
    test.write_text(json.dumps(values | {"frames": frames[5:]}))
    assert [view.name for view in load(tmp_path).test_views] == ["r_6", "r_7", "r_8"]
    for other in (json.dumps(values | {"frames": frames[7:]}), "{}"):  # Files of another set, or damaged
        test.write_text(other)
        assert [view.name for view in load(tmp_path).test_views] == ["r_4"]
    test.write_text(json.dumps(values))
    (tmp_path / "transforms.json").unlink()
    assert [view.name for view in load(test).test_views] == ["r_4"], "a file that is given itself has all its frames"


@pytest.mark.parametrize("new", [0, 2])
@pytest.mark.parametrize("place", ["images", "test"])
def test_photos_that_are_trained_on_are_not_held_out(tmp_path, place, new):
    """A test split of the training photos, by name or as copies, tests nothing; its own photos stay."""
    write_blender(tmp_path, 11)
    values = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").unlink()
    if place != "images":
        shutil.copytree(tmp_path / "images", tmp_path / place)
    tested = [frame | {"file_path": frame["file_path"].replace("images", place)} for frame in values["frames"]]
    for split, frames in (("train", values["frames"][: 11 - new]), ("test", tested)):
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(values | {"frames": frames}))
    scene = load(tmp_path)
    assert any(line.startswith(f"{11 - new} test photos are training photos, too") for line in scene.notes), scene.notes
    assert [view.name[-3:] for view in scene.test_views] == (["r_9", "_10"] if new else ["r_4"])
    assert len(scene.train_views) == (9 if new else 10)


def test_fields_that_are_not_read_are_named(tmp_path):
    write_blender(tmp_path, 3, fisheye_crop_radius=12, rolling_shutter=[0, 0, 0, 0], mask_color=[[0], [0, 2]])
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    _edit(tmp_path, frames=[frame | {"time": i / 2, "depth_file_path": "d.png"} for i, frame in enumerate(frames)])
    notes = read_transforms(tmp_path).notes
    assert "fields of the frames that are not read: depth_file_path, fisheye_crop_radius, mask_color" in notes
    assert "frames differ in time (3 values), which is not read: what moves is not modeled" in notes
    assert not any("frames differ in iso" in note for note in notes)
    _edit(tmp_path, frames=[frame | {"iso": 100 * (i + 1)} for i, frame in enumerate(frames)])
    note = "frames differ in iso (3 values), which is not read: exposure_time has to contain it"
    assert note in read_transforms(tmp_path).notes


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"orthographic": True}, "states a lens by orthographic"),
        ({"fl_x": 0.6, "fl_y": 0.6}, "too short for 40 x 30 pixels; state focal lengths and principal point in pixels"),
        ({"fl_x": 1e12, "fl_y": 1e12}, "are longer than 1e\\+09 pixels"),
        ({"camera_angle_x": "wide"}, "camera_angle_x = 'wide'"),
        ({"camera_angle_x": 4.0}, "no focal length"),
        ({"camera_model": "EQUIRECTANGULAR"}, "equirectangular photos are 40 x 30"),
        ({"fl_x": -5.0}, "not positive"),
        ({"w": 30, "h": 40}, "image is 40 x 30, its camera 30 x 40"),
        (
            {"from_mitsuba": True, "frames": [{"file_path": "images/r_0", "transform_matrix": [[1]]}]},
            "not a finite 4 x 4 matrix",
        ),
    ],
)
def test_bad_transforms_are_refused(tmp_path, fields, message):
    write_blender(tmp_path)
    _edit(tmp_path, **fields)
    with pytest.raises(InputError, match=message):
        load(tmp_path)


def test_transforms_of_another_shape_are_refused(tmp_path):
    write_blender(tmp_path)
    texts = ["", "{", "[]", '{"frames": ' + "[" * 100_000, '{"frames": []}', '{"frames": [1, 2]}']
    frames = {"file_path": "../../etc/passwd", "transform_matrix": []}, {"file_path": 7}, {"file_path": "images/r_0"}
    for text in [*texts, *(json.dumps({"camera_angle_x": 1, "frames": [frame]}) for frame in frames)]:
        (tmp_path / "transforms.json").write_text(text)
        with pytest.raises(InputError, match=r"transforms\.json"):
            load(tmp_path)


def test_exr_among_photos_is_refused_and_beside_one_is_truth(tmp_path):
    import OpenEXR

    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            frame["file_path"] = f"images/r_{i}.exr"
            with OpenEXR.File({}, {"RGB": np.full((30, 40, 3), i + 1, np.float32)}) as file:
                file.write(str(tmp_path / frame["file_path"]))
    scene = load(tmp_path, cache=tmp_path / "cache")
    assert [view.hdr.max() for view in scene.views] == [1, 2, 3, 4, 5, 6]
    (tmp_path / "images" / "r_2.png").unlink()
    scene = load(tmp_path)
    assert len(scene.views) == 5 and any(
        note.startswith("r_2.exr (float images) were left out") for note in scene.notes
    )


@pytest.fixture(scope="module")
def room(tmp_path_factory, shared):
    folder = tmp_path_factory.mktemp("room")
    return folder, write_room(folder, shared, size=100, count=12)


def test_hdr_nerf_round_trip(room, shared):
    folder, times = room
    views = room_views(shared, size=100, count=12)
    for index, expected in ((None, 2), (0, 0), (4, 4)):
        scene = load(folder, exposure_index=index)
        assert scene.format == "hdr-nerf" and len(scene.train_views) == len(scene.test_views) == 6
        assert {view.exposure_time for view in scene.views} == {times[expected]}
        read = {view.name: view for view in scene.views}
        for view in views:
            np.testing.assert_allclose(read[view.name].hdr, view.radiance, rtol=6e-4, atol=1e-7)
            exact = reinhard_gamma(view.radiance * times[expected])
            assert np.abs(read[view.name].image - exact).max() <= 0.5 / 255 + 1e-6
            np.testing.assert_allclose(read[view.name].camera.world_to_camera, view.camera.world_to_camera, atol=1e-9)
            np.testing.assert_allclose(read[view.name].camera.intrinsics, view.camera.intrinsics, rtol=1e-12)
    assert len(scene.points) == 21600
    with pytest.raises(InputError, match=r"index 7 asked for, but the exposures are \[0, 1, 2, 3, 4\]"):
        load(folder, exposure_index=7)


@pytest.mark.parametrize("value, message", [(0, "0"), (-1, "-1"), ("NaN", "NaN"), (None, "None")])
def test_impossible_exposures_are_refused(room, tmp_path, value, message):
    folder = tmp_path / "set"
    folder.mkdir()
    for name in ("transforms_train.json", "transforms_test.json", "exposure_test.json", "train", "train_hdr", "test"):
        (folder / name).symlink_to(room[0] / name)
    times = json.loads((room[0] / "exposure_train.json").read_text())
    times[next(iter(times))] = value
    (folder / "exposure_train.json").write_text(json.dumps(times))
    with pytest.raises(InputError, match=f"exposure time of .* is {message}|'{message}'"):
        load(folder)


def test_hdr_nerf_real_layout(tmp_path):
    poses, seconds = write_llff(tmp_path, size=(40, 30)), (0.1, 0.4, 1.6)
    (tmp_path / "input_images").mkdir()
    for i in range(6):
        for k in range(3):
            (tmp_path / "input_images" / f"{i:03d}_{k}.png").symlink_to(tmp_path / "images" / f"{i:03d}.png")
    rows = np.load(tmp_path / "poses_bounds.npy").repeat(3, axis=0)
    rows = np.concatenate([rows, np.tile(seconds, 6)[:, None]], axis=1)
    np.save(tmp_path / "poses_bounds_exps.npy", rows)
    scene = load(tmp_path, exposure_index=1, cache=tmp_path / "cache")
    assert scene.format == "hdr-nerf-real" and [view.name for view in scene.test_views] == ["001", "003", "005"]
    for view, pose in zip(scene.views, poses, strict=True):
        np.testing.assert_allclose(view.camera.world_to_camera, pose, atol=1e-9)
        assert view.exposure_time == 0.4 and (view.camera.fx, view.camera.cx) == (50, 20)
    np.save(tmp_path / "poses_bounds_exps.npy", rows[:, :17])
    with pytest.raises(InputError, match=r"not an \[n, 18\] array"):
        load(tmp_path)
    with (tmp_path / "poses_bounds_exps.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40, 18)})
    with pytest.raises(InputError, match=r"not an \[n, 18\] array"):
        load(tmp_path)


def test_llffs_axes_size_and_focal_length(tmp_path):
    poses = write_llff(tmp_path)
    scene = load(tmp_path, cache=tmp_path / "cache")
    assert scene.format == "llff" and [view.name for view in scene.views] == [f"{i:03d}" for i in range(6)]
    for i, (view, pose) in enumerate(zip(scene.views, poses, strict=True)):
        np.testing.assert_allclose(view.camera.world_to_camera, pose, atol=1e-9)
        assert (view.camera.width, view.camera.height, view.camera.fx, view.camera.cx) == (64, 48, 50.0, 32.0)
        np.testing.assert_allclose(view.image, pattern(64, 48, seed=i) / 255, atol=1e-6)


def test_a_model_without_images_does_not_hide_the_poses_of_llff(tmp_path):
    write_llff(tmp_path)
    write_colmap(tmp_path / "other", binary=True)
    (tmp_path / "sparse").mkdir()
    (tmp_path / "other" / "sparse" / "0").rename(tmp_path / "sparse" / "0")
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    scene = load(tmp_path, holdout=0)
    assert scene.views[0].camera.fx == pytest.approx(50)
    assert [note for note in scene.notes if "sparse" in note] == [
        "sparse/0 has no images.bin or images.txt: its cameras are not used"
    ]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: rows[:-1], "5 rows for 6 images"),
        (lambda rows: rows[:, :-1], "is not an \\[n, 17\\] array"),
        (lambda rows: np.where(np.arange(17) == 3, np.nan, rows), "is not finite"),
    ],
)
def test_llff_rows_that_do_not_fit_are_refused(tmp_path, spoil, message):
    write_llff(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", spoil(np.load(tmp_path / "poses_bounds.npy")))
    with pytest.raises(InputError, match=message):
        load(tmp_path)


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
