"""Cameras that other tools state wrongly: at a false place, for another size, or by another convention."""

import numpy as np
import pytest

from sehdr_warp.scene import look_at
from sehdr_warp.scene.camera_checks import check_cameras
from sehdr_warp.scene.dataparser import NO_POINTS, ImageRecord, PointCloud
from sehdr_warp.scene.lens import Lens
from tests.make_scenes import arc_poses, load, write_blender, write_colmap, write_ply

POINTS = np.random.default_rng(0).normal(0, 0.5, (200, 3))
CLOUD = PointCloud(POINTS, np.zeros((200, 3), np.float32))


def records(folder, poses, center=(20.0, 15.0)):
    lens = Lens("PINHOLE", 40, 30, (40.0, 40.0, *center), folder)
    return [ImageRecord(str(i), folder / f"{i}.png", lens, pose) for i, pose in enumerate(poses)]


@pytest.mark.parametrize("cloud", [NO_POINTS, CLOUD])
def test_a_camera_far_from_all_others_is_left_out(tmp_path, cloud):
    poses = [*arc_poses(8), look_at((3000.0, 0.0, 9000.0))]
    checked, notes = check_cameras(records(tmp_path, poses), cloud)
    assert [record.view for record in checked] == [str(i) for i in range(8)]
    assert "1 camera is" in notes[0] and "its photo was left out: 8.png" in notes[0]
    # Ten times as far is where people go.
    near, notes = check_cameras(records(tmp_path, [*arc_poses(8), look_at((0.0, -20.0, 0.5))]), cloud)
    assert len(near) == 9 and not notes


def test_cameras_on_a_tripod_beside_others_stay(tmp_path):
    still = [look_at((0.001 * i, -4.0, 0.5)) for i in range(8)]
    checked, notes = check_cameras(records(tmp_path, [*still, look_at((1.0, -4.0, 0.5))]), CLOUD)
    assert len(checked) == 9 and not notes


@pytest.mark.parametrize("place", [0.0, 4.5e6])
def test_cameras_that_all_stand_at_one_place_are_named(tmp_path, place):
    """An export lost the positions, or the camera only turned."""
    poses = [look_at((place, 0.0, 0.0), (place + np.sin(a), np.cos(a), 0.0)) for a in np.linspace(0, 3, 6)]
    (note,) = check_cameras(records(tmp_path, poses), NO_POINTS)[1]
    assert note.startswith(
        f"all 6 cameras are at one place ({place:.4g}, 0, 0), and show no depth: check that the poses"
    )
    poses[3:] = [look_at((place + 0.1, 0.0, 0.0), (place, 1.0, 0.0))] * 3
    assert not check_cameras(records(tmp_path, poses), NO_POINTS)[1]


def test_poses_of_another_convention_are_named(tmp_path):
    poses, flip = arc_poses(8), np.diag([1.0, -1.0, -1.0, 1.0])
    assert not check_cameras(records(tmp_path, poses), CLOUD)[1]
    one_place, inverted = check_cameras(records(tmp_path, [np.linalg.inv(pose) for pose in poses]), CLOUD)[1]
    assert "all 8 cameras are at one place" in one_place  # Cameras that look at the origin, read as if inverted
    assert "show 0 %" in inverted and "are read inverted" in inverted
    (turned,) = check_cameras(records(tmp_path, [flip @ pose for pose in poses]), CLOUD)[1]
    assert "show 0 %" in turned and "in other axes" in turned


def test_a_principal_point_of_another_size_is_named(tmp_path):
    (note,) = check_cameras(records(tmp_path, arc_poses(6), (80.0, 60.0)), CLOUD)[1]
    assert "6 of 6 photos" in note and "(80, 60) in 40 x 30 pixels" in note


def test_notes_reach_the_scene(tmp_path, caplog):
    write_blender(tmp_path / "a", cx=38.0, ply_file_path="cloud.ply")
    write_ply(tmp_path / "a" / "cloud.ply", POINTS.tolist())
    assert any("principal point of 6 of 6 photos" in note for note in load(tmp_path / "a").notes)
    write_colmap(tmp_path / "b")
    with (tmp_path / "b" / "sparse" / "0" / "points3D.txt").open("a") as file:
        file.write("99 nan inf 0 10 10 10 0.5\n")
    assert len(load(tmp_path / "b").points) == 5 and "1 of 6 points are not finite" in caplog.text
