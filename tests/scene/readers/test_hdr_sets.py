"""Sets of HDR-NeRF and HDR-GS."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene.dataparser import reinhard_gamma
from sehdr_warp.scene.load import parse_dataset
from tests.make_scenes import arc_poses, load, room_views, write_blender, write_colmap, write_llff, write_room


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


@pytest.mark.parametrize("value, message", [(0, "0"), (-1, "-1"), ("NaN", "NaN"), (None, "null")])
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


def test_hdr_gs_layout(tmp_path):
    write_colmap(tmp_path, name="{}_1.png")
    (tmp_path / "exr").mkdir()
    import OpenEXR

    truth = {}
    for i in range(6):
        truth[i] = np.random.default_rng(i).random((48, 64, 3)).astype(np.float32) + 0.1
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": truth[i]}) as file:
            file.write(str(tmp_path / "exr" / f"{i}.exr"))
        for k, seconds in enumerate((0.125, 0.5, 2, 8, 32)):
            code = (reinhard_gamma(truth[i] * seconds) * 255 + 0.5).astype(np.uint8)
            Image.fromarray(code).save(tmp_path / "images" / f"{i}_{k}.png")
    scene = load(tmp_path, exposure_index=3)
    assert scene.format == "hdr-gs" and [view.name for view in scene.test_views] == ["1", "3", "5"]
    assert {view.exposure_time for view in scene.views} == {8.0}
    for i, view in enumerate(scene.views):
        np.testing.assert_array_equal(view.hdr, truth[i])
        np.testing.assert_allclose(view.image, reinhard_gamma(truth[i] * 8), atol=0.5 / 255 + 1e-6)
        np.testing.assert_allclose(view.camera.world_to_camera, arc_poses(6)[i], atol=1e-12)


def test_a_model_elsewhere_makes_no_hdr_gs_set(tmp_path):
    write_blender(tmp_path)
    write_colmap(tmp_path / "other")
    (tmp_path / "other" / "sparse" / "0").rename(tmp_path / "model")
    shutil.rmtree(tmp_path / "other")
    (tmp_path / "exr").mkdir()
    for i in range(6):
        shutil.copy(tmp_path / "images" / f"r_{i}.png", tmp_path / "images" / f"v{i}_0.png")
        (tmp_path / "exr" / f"v{i}.exr").touch()
    assert parse_dataset(tmp_path).format == "transforms"


def test_an_exr_folder_beside_numbered_photos_is_not_hdr_gs(tmp_path):
    write_colmap(tmp_path, name="IMG_{:03d}.png")
    (tmp_path / "exr").mkdir()
    (tmp_path / "exr" / "probe.exr").write_bytes(b"x")
    assert parse_dataset(tmp_path).format == "colmap"
