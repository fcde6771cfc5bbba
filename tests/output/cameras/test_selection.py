"""Cameras by split, name, file and size."""

import json

import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.output.cameras.selection import select_cameras
from sehdr_warp.output.render_views import render_views
from sehdr_warp.scene import Camera, load_cameras

from ..helpers import AnalyticRun, camera, read_exr


def test_several_cameras_are_chosen_from_by_name(tmp_path):
    run = AnalyticRun()
    entries = [{"name": name, **camera().to_dict()} for name in ("a", "a_2000", "b_0001", "b_0002", "c_001")]
    (tmp_path / "c.json").write_text(json.dumps({"cameras": entries}))
    assert [name for name, _ in select_cameras(run, tmp_path / "c.json", camera="b")] == ["b_0001", "b_0002"]
    assert [name for name, _ in select_cameras(run, tmp_path / "c.json", camera="a")] == ["a"]
    with pytest.raises(SehdrError, match="has no camera 'c'"):
        select_cameras(run, tmp_path / "c.json", camera="c")
    with pytest.raises(SehdrError, match="chooses a photo or from a file"):
        select_cameras(run, "orbit", camera="a")
    photo = run.cameras[-1]
    for split in ("train", "test", "all"):
        assert select_cameras(run, split, camera=photo.name) == [(photo.name, photo.camera)]
    for cameras, message in (
        (run.cameras, rf"one of the scene's.*did you mean {photo.name}"),
        ([], "no cameras, and so"),
    ):
        run.cameras = cameras
        with pytest.raises(SehdrError, match=message):
            select_cameras(run, "test", camera=f"{photo.name}x")
    assert len(load_cameras(tmp_path / "c.json")) == 5
    with pytest.raises(TypeError, match=r"cameras is a list, expected one of train, test, .* or a file; for a Camera"):
        select_cameras(run, [photo.camera])


def test_size_keeps_the_vertical_field_of_view(tmp_path):
    run = AnalyticRun()
    render_views(run, tmp_path, size="64x36")
    camera_ = Camera.from_dict(json.loads(read_exr(tmp_path / "hdr" / "t_0.exr")[2]["sehdr:camera"]))
    camera_path = run.cameras[3].camera
    assert (camera_.width, camera_.height) == (64, 36) and camera_.fy / 36 == camera_path.fy / camera_path.height
    assert (camera_.cx - 32) / camera_.fx == pytest.approx((camera_path.cx - camera_path.width / 2) / camera_path.fx)
    for size in ("64", "5000000x4", "0x9", "axb", "99999x99999"):
        with pytest.raises(SehdrError, match="such as 1920x1080"):
            render_views(run, tmp_path / "other", size=size)
