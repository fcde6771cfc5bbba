"""Cameras in files of other programs, and which of them are one that moves."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.output.cameras.exchange import camera_path
from sehdr_warp.output.cameras.selection import select_cameras
from sehdr_warp.output.render_views import render_views
from sehdr_warp.scene import load_cameras
from tests.make_scenes import write_colmap

from ..helpers import AnalyticRun, camera


def test_cameras_go_to_usd_and_come_back(tmp_path):
    pytest.importorskip("pxr")
    run = AnalyticRun([("a 1", "train"), ("a_1", "train"), ("2", "train")])
    render_views(run, tmp_path, cameras="train", axes="scene")
    read = load_cameras(tmp_path / "cameras.usda")
    assert [name for name, _ in read] == ["a_1", "a_1_2", "_2"]
    for entry, (_, camera_) in zip(run.cameras, read, strict=True):
        np.testing.assert_allclose(camera_.world_to_camera, entry.camera.world_to_camera, atol=1e-9)
        np.testing.assert_allclose(camera_.intrinsics, entry.camera.intrinsics, rtol=1e-6)
        assert (camera_.width, camera_.height) == (entry.camera.width, entry.camera.height)


def test_panoramas_are_not_pinholes_of_usd(tmp_path, logged):
    run = AnalyticRun()
    panorama = replace(run.cameras[0].camera, width=64, height=32, projection="equirectangular")
    entries = [{"name": "pano", **panorama.to_dict()}, {"name": "pinhole", **camera().to_dict()}]
    for name, chosen in (("both", entries), ("one", entries[:1])):
        (tmp_path / f"{name}.json").write_text(json.dumps({"cameras": chosen}))
        files = render_views(run, tmp_path / name, cameras=tmp_path / f"{name}.json")
        stage = tmp_path / name / "cameras.usda"
        assert stage.exists() == (stage in files) == (name == "both")
    text = (tmp_path / "both" / "cameras.usda").read_text()
    assert 'Camera "pinhole"' in text and "pano" not in text
    assert sum(line.startswith("cameras.usda: without pano, because OpenUSD has neither") for line in logged) == 2
    with pytest.raises(SehdrError, match="64x48 would distort a panorama; write one twice as wide as high"):
        render_views(run, tmp_path / "size", cameras=tmp_path / "one.json", size="64x48")


def test_a_path_is_one_moving_camera(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    run = AnalyticRun()
    render_views(run, tmp_path, cameras="orbit", count=5, size="32x18", fps=25)
    stage = Usd.Stage.Open(str(tmp_path / "cameras.usda"))
    prims = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    assert [prim.GetName() for prim in prims] == ["orbit"]
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 4, 25)
    path = json.loads((tmp_path / "camera_path.json").read_text())
    assert stage.GetFramesPerSecond() == path["fps"] == 25 and path["seconds"] == pytest.approx(5 / 25)
    expected = select_cameras(run, "orbit", count=5)
    for name in ("cameras.usda", "cameras.chan", "camera_path.json"):
        read = select_cameras(run, tmp_path / name)
        assert len(read) == 5
        for (_, a), (_, b) in zip(expected, read, strict=True):
            np.testing.assert_allclose(b.position, a.position, atol=1e-5)
            np.testing.assert_allclose(b.world_to_camera, a.world_to_camera, atol=1e-5)
            assert b.fy / b.height == pytest.approx(a.fy / a.height, rel=1e-5)


def test_numbered_photos_of_a_colmap_folder_are_not_frames_of_one_camera(tmp_path):
    write_colmap(tmp_path / "set", name="IMG_{:03d}.png")
    render_views(AnalyticRun(), tmp_path / "out", cameras=tmp_path / "set")
    text = (tmp_path / "out/cameras.usda").read_text()
    assert "IMG_000" in text and "IMG_001" in text, "each photo is a camera of its own"
    assert not (tmp_path / "out/camera_path.json").exists()


def test_only_numbered_views_of_one_size_are_a_path():
    views = [(f"shot_{i:04d}", camera()) for i in range(1001, 1004)]
    path = camera_path(views)
    assert path is not None and (path.name, path.frames) == ("shot", [1001, 1002, 1003])
    assert camera_path(views[:1]) is None
    assert camera_path([*views[:2], ("shot_1009", camera())]) is None
    assert camera_path([*views[:2], ("other_1003", camera())]) is None
    assert camera_path([*views[:2], ("shot_1003", camera(width=64))]) is None
    assert camera_path([("left", camera()), ("right", camera())]) is None
