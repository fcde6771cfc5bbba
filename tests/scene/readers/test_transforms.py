"""transforms.json in its dialects, HDR-NeRF's two layouts, LLFF, and cameras to render from."""

import json

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene.readers.transforms import is_transforms, read_transforms
from tests.make_scenes import arc_poses, edit_transforms, edited_json, load, write_blender, write_colmap, write_ply


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


def test_points_that_a_scale_moves_to_infinity_are_refused(tmp_path):
    write_blender(tmp_path, applied_scale=1.7e308)
    write_colmap(tmp_path / "colmap")
    with pytest.raises(InputError, match=r"transforms.json: applied_transform and applied_scale move points to inf"):
        load(tmp_path)


def test_poses_of_mitsuba_have_x_to_the_left_and_z_ahead(tmp_path):
    write_blender(tmp_path, 3)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    for frame in frames:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1, 1, -1, 1])).tolist()
    edit_transforms(tmp_path, frames=frames, from_mitsuba=True)
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
    edit_transforms(tmp_path, frames=[frames[0] | {"file_path": "images/r%200.png"}, *frames[1:]])
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


def test_fields_that_are_not_read_are_named(tmp_path):
    write_blender(tmp_path, 3, fisheye_crop_radius=12, rolling_shutter=[0, 0, 0, 0], mask_color=[[0], [0, 2]])
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    edit_transforms(
        tmp_path, frames=[frame | {"time": i / 2, "depth_file_path": "d.png"} for i, frame in enumerate(frames)]
    )
    notes = read_transforms(tmp_path).notes
    assert "fields of the frames that are not read: depth_file_path, fisheye_crop_radius, mask_color" in notes
    assert "frames differ in time (3 values), which is not read: what moves is not modeled" in notes
    assert not any("frames differ in iso" in note for note in notes)
    edit_transforms(tmp_path, frames=[frame | {"iso": 100 * (i + 1)} for i, frame in enumerate(frames)])
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
    edit_transforms(tmp_path, **fields)
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


def test_frames_without_photos_are_left_out_and_named(tmp_path):
    """The published fox set is like this: 17 of 67 frames have no photo."""
    write_blender(tmp_path, 9)
    for i in (1, 4, 8):
        (tmp_path / "images" / f"r_{i}.png").unlink()
    scene = load(tmp_path)
    assert len(scene.views) == 6
    assert "3 of 9 frames have no photo and were left out: ./images/r_1, ./images/r_4, ./images/r_8" in scene.notes
    (tmp_path / "images").rename(tmp_path / "My Photos")
    remedy = "photos of these names are in My Photos: rename it to images"
    with pytest.raises(InputError, match=f"image file not found, nor any of 9 frames; {remedy}"):
        load(tmp_path)


def test_frames_of_no_stated_size_whose_photo_cannot_be_opened_are_left_out_and_named(tmp_path):
    write_blender(tmp_path, 6)
    (tmp_path / "images" / "r_2.png").write_bytes(b"damaged")
    scene = load(tmp_path)
    assert len(scene.views) == 5
    (note,) = (note for note in scene.notes if "r_2" in note)
    assert note.startswith("1 of 6 photos cannot be used and were left out (r_2.png: ")
    edit_transforms(tmp_path, camera_angle_x=None)
    with pytest.raises(InputError, match="transforms.json: states no focal length"):
        load(tmp_path)


@pytest.mark.parametrize("change", ["null model", "text numbers", "flat pose", "mark", "matrix", "all in one folder"])
def test_transforms_as_apps_write_them(tmp_path, change):
    write_blender(tmp_path, 6)
    file = tmp_path / "transforms.json"
    before, values = load(tmp_path, holdout=0), json.loads(file.read_text())
    if change == "null model":
        values["camera_model"] = None
    elif change == "text numbers":
        values |= {"w": "40", "h": "30", "camera_angle_x": str(values["camera_angle_x"])}
    elif change == "flat pose":
        values["frames"] = [
            frame | {"transform_matrix": np.ravel(frame["transform_matrix"]).tolist()} for frame in values["frames"]
        ]
    elif change == "matrix":
        focal = 20 / np.tan(values.pop("camera_angle_x") / 2)  # Of photos of 40 x 30 pixels
        matrix = [[focal, 0, 20], [0, focal, 15], [0, 0, 1]]
        values["frames"] = [frame | {"K": matrix} for frame in values["frames"]]
    elif change == "all in one folder":
        for photo in (tmp_path / "images").iterdir():
            photo.rename(tmp_path / photo.name)
        (tmp_path / "images").rmdir()
    file.write_bytes(b"\xef\xbb\xbf" * (change == "mark") + json.dumps(values).encode())
    scene = load(tmp_path, holdout=0)
    for view, other in zip(scene.views, before.views, strict=True):
        np.testing.assert_array_equal(view.camera.world_to_camera, other.camera.world_to_camera)
        assert view.camera.intrinsics == pytest.approx(other.camera.intrinsics)
        assert (view.camera.fx, view.camera.width) == (other.camera.fx, other.camera.width)


@pytest.mark.parametrize("value", ["", "wide", "nan", "inf"])
def test_text_that_is_no_number_is_named(tmp_path, value):
    write_blender(tmp_path, 6, fl_x=value)
    with pytest.raises(InputError, match=f"fl_x = '?{value}'? is not a finite number"):
        load(tmp_path)


def test_masks_and_points_that_are_missing_are_named(tmp_path):
    write_blender(tmp_path, 6, ply_file_path="sparse_pc.ply")
    file = tmp_path / "transforms.json"
    with edited_json(file) as values:
        values["frames"][1]["mask_path"] = "masks/r_1.png"
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6
    assert "1 mask that a frame states is not here, and its photo counts whole: r_1.png" in scene.notes
    assert "the points that transforms.json states are not here: 'sparse_pc.ply'" in scene.notes


@pytest.mark.parametrize("before", ["./m/", "m\\", "/home/other/room/m/", "C:\\room\\m\\"])
def test_masks_and_points_under_other_spellings(tmp_path, before):
    """instant-DexNerf issue 3 and exports of Windows: photos were found by such names, masks and points were not."""
    write_blender(tmp_path, 6, ply_file_path=f"{before}cloud.ply")
    (tmp_path / "m").mkdir()
    write_ply(tmp_path / "m" / "cloud.ply", [(0, 0, 0), (1, 2, 3)])
    file = tmp_path / "transforms.json"
    with edited_json(file) as values:
        for i, frame in enumerate(values["frames"]):
            frame["mask_path"] = f"{before}half_{i}.png" if i else ""
            Image.fromarray(np.eye(30, 40, dtype=np.uint8) * 255).save(tmp_path / "m" / f"half_{i}.png")
    scene = load(tmp_path, holdout=0)
    assert [view.mask is None for view in scene.views] == [True] + [False] * 5
    assert "not here" not in str(scene.notes) and len(scene.points) == 2


def test_splits_under_other_spellings(tmp_path):
    """nerfstudio compares its lists of names as paths: `./images/r_0` is `images/r_0`."""
    names = [f"images/r_{i}" for i in range(6)]
    write_blender(tmp_path, 6, train_filenames=names[:4], test_filenames=["./" + names[4], names[5].replace("/", "\\")])
    assert [view.name for view in load(tmp_path).test_views] == ["r_4", "r_5"]


def test_files_of_frames_without_poses_are_no_transforms(tmp_path):
    path = tmp_path / "capture.json"
    for text, is_one in (('{"frames": [{"transform_matrix": []}]}', True), ('{"frames": []}', False)):
        path.write_text(text)
        assert is_transforms(path) == is_one
