import json

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.cameras.selection import select_cameras
from sehdr_warp.output.images.display import display_gain
from sehdr_warp.output.render_views import render_views
from sehdr_warp.own_files import LIST
from sehdr_warp.scene.exposure.compensation import ExposureCompensation

from .helpers import AnalyticRun, camera, read_exr


def tree(folder):
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != LIST)
    return sorted(str(path.relative_to(folder)) for path in files)


def test_layout_on_disk(tmp_path, logged):
    files = render_views(AnalyticRun(), tmp_path / "out", evs=[-2, 0, 2])
    expected = ["hdr/t_0.exr", "hdr/t_1.exr", "preview/t_0.png", "preview/t_1.png", "brackets.json", "cameras.usda"]
    expected += [
        f"brackets/{v}/{v}_b{i}_ev{ev}.exr" for v in ("t_0", "t_1") for i, ev in enumerate(("-2.0", "+0.0", "+2.0"))
    ]
    assert tree(tmp_path / "out") == sorted(expected) == sorted(str(f.relative_to(tmp_path / "out")) for f in files)
    assert logged[-1] == "rendering views: 2"


def test_hdr_file_holds_what_was_rendered(tmp_path):
    run = AnalyticRun()
    render_views(run, tmp_path, pixel="float", axes="scene")
    entry = run.cameras[3]
    pixels, names, header = read_exr(tmp_path / "hdr" / "t_0.exr")
    rendered = run.render(entry.camera)
    assert names == ("R", "G", "B", "A", "Z", "confidence")
    np.testing.assert_array_equal(pixels[..., :3], rendered.hdr)
    np.testing.assert_array_equal(pixels[..., 3], rendered.alpha)
    np.testing.assert_array_equal(pixels[..., 4], rendered.depth)
    np.testing.assert_array_equal(pixels[..., 5], run.render_confidence(entry.camera))
    assert header["expTime"] == 1 and header["sehdr:baseExposureTime"] == "0.5"
    assert header["sehdr:scene"] == "sky" and header["sehdr:view"] == "t_0"
    assert json.loads(header["sehdr:camera"]) == entry.camera.to_dict()
    assert Image.open(tmp_path / "preview" / "t_0.png").size == (entry.camera.width, entry.camera.height)


def test_lines_say_that_confidence_is_missing_and_values_are_past_half(tmp_path, logged):
    run = AnalyticRun()
    run.confident, run.gain = False, 1e5
    render_views(run, tmp_path)
    assert "t_0: holds values above 65504, which half cannot; written as float" in logged
    assert read_exr(tmp_path / "hdr" / "t_0.exr")[1] == ("R", "G", "B", "A", "Z")
    assert sum("without a confidence channel" in line for line in logged) == 1


def test_brackets_are_the_hdr_file_times_the_exposure(tmp_path):
    render_views(AnalyticRun(), tmp_path, exposures=[0.125, 8], pixel="float", colorspace="acescg", multipart=False)
    hdr = read_exr(tmp_path / "hdr" / "t_1.exr")[0][..., :3].astype(np.float64)
    for name, time in (("t_1_b0_ev-2.0", 0.125), ("t_1_b1_ev+4.0", 8)):
        np.testing.assert_array_equal(
            read_exr(tmp_path / "brackets" / "t_1" / f"{name}.exr")[0], (hdr * time).astype(np.float32)
        )


def test_white_is_an_exposure_that_the_file_states(tmp_path):
    run = AnalyticRun()
    render_views(run, tmp_path / "a", pixel="float", reference_white=1.0)
    render_views(run, tmp_path / "b", pixel="float")
    exposed, _, header = read_exr(tmp_path / "a" / "hdr" / "t_0.exr")
    plain = read_exr(tmp_path / "b" / "hdr" / "t_0.exr")[0]
    time = run.base_time * display_gain(run.response)
    assert header["expTime"] == pytest.approx(time)
    np.testing.assert_allclose(exposed[..., :3], plain[..., :3] * time, rtol=1e-6)
    np.testing.assert_array_equal(exposed[..., 3:], plain[..., 3:])
    for white in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(SehdrError, match="white"):
            render_views(run, tmp_path / "c", reference_white=white)


def test_folders_by_exposure_hold_sequences(tmp_path):
    listed = render_views(
        AnalyticRun(), tmp_path, cameras="orbit", count=3, evs=[-2, 0], group_by="exposure", ldr_brackets="png"
    )
    assert sorted(str(file.relative_to(tmp_path)) for file in listed) == tree(tmp_path)
    names = [f"orbit_{i:03d}" for i in range(3)]
    for folder, suffix in (("brackets", "exr"), ("brackets_ldr", "png")):
        file_names = [f"{label}/{name}.{suffix}" for label in ("b0_ev-2.0", "b1_ev+0.0") for name in names]
        assert tree(tmp_path / folder) == file_names
    manifest = json.loads((tmp_path / "brackets.json").read_text())
    files = [each["file"] for view in manifest["views"] for each in view["exposures"]]
    assert len(files) == 6 and all((tmp_path / file).is_file() for file in files)
    with pytest.raises(SehdrError, match="multi-part"):
        render_views(AnalyticRun(), tmp_path / "b", evs=[0], group_by="exposure", multipart=True)


def test_nothing_is_replaced_unless_asked_and_rendering_does_not_start(tmp_path):
    run = AnalyticRun()
    render_views(run, tmp_path, evs=[0])
    (tmp_path / "note.txt").write_text("mine")
    run.rendered = 0
    with pytest.raises(InputError, match="exists already"):
        render_views(run, tmp_path)
    assert run.rendered == 0
    render_views(run, tmp_path, cameras="train", evs=[1], overwrite=True)
    assert [path.name for path in sorted((tmp_path / "hdr").glob("[!.]*"))] == ["r_0.exr", "r_1.exr", "r_2.exr"]
    assert (tmp_path / "note.txt").read_text() == "mine"


def test_an_earlier_render_leaves_nothing_beside_a_new_one(tmp_path, logged):
    run = AnalyticRun()
    earlier = {"cameras": "orbit", "count": 2, "evs": [0], "ldr_brackets": "png"}
    render_views(run, tmp_path, **earlier)
    (tmp_path / "note.txt").write_text("mine")
    files = render_views(run, tmp_path, overwrite=True)
    assert tree(tmp_path) == sorted([*(str(file.relative_to(tmp_path)) for file in files), "note.txt"])
    assert f"{tmp_path / 'cameras.chan'}: removed, because an earlier call wrote it and this one does not" in logged
    # What somebody changed or added is theirs, and so is a folder or a link of their own.
    render_views(run, tmp_path, overwrite=True, **earlier)
    (tmp_path / "cameras.chan").write_text("1 0 0 0 0 0 0 50\n")
    (tmp_path / "brackets" / "note.txt").write_text("mine")
    (tmp_path / "camera_path.json").rename(tmp_path / "path.json")
    (tmp_path / "camera_path.json").symlink_to("path.json")
    user_files = [*(tmp_path / "brackets").rglob("*.*"), tmp_path / "path.json", tmp_path / "cameras.chan"]
    render_views(run, tmp_path, overwrite=True)
    assert all(path.exists() for path in user_files) and (tmp_path / "camera_path.json").is_symlink()
    assert not (tmp_path / "brackets_ldr").exists() and not (tmp_path / "brackets.json").exists()
    for name in ("brackets", "cameras.chan", "camera_path.json"):
        assert any(line.startswith(f"{tmp_path / name}: kept, although") for line in logged)


@pytest.mark.parametrize("multipart", [False, True])
def test_a_bad_pixel_leaves_nothing_new(tmp_path, multipart):
    run = AnalyticRun()
    run.gain = np.inf
    with pytest.raises(InputError, match="not finite"):
        render_views(run, tmp_path / "deep" / "out", evs=[0], multipart=multipart)
    assert not (tmp_path / "deep").exists()


def test_options_that_do_nothing_are_refused(tmp_path):
    with pytest.raises(SehdrError, match="brackets need exposures"):
        render_views(AnalyticRun(), tmp_path / "out", multipart=True)
    with pytest.raises(SehdrError, match="brackets need exposures"):
        render_views(AnalyticRun(), tmp_path / "out", group_by="exposure")
    with pytest.raises(SehdrError, match=r"no test views; choose other cameras \(train, all, "):
        render_views(AnalyticRun([("a", "train")]), tmp_path / "out")
    with pytest.raises(SehdrError, match="'tset' are neither a file nor one of train, test, all, orbit, interpolate"):
        render_views(AnalyticRun(), tmp_path / "out", cameras="tset")
    assert not (tmp_path / "out").exists()
    entries = [{"name": name, **camera(position=(i, 0, -3)).to_dict()} for i, name in enumerate(("a", "b"))]
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": entries}))
    assert [name for name, _ in select_cameras(AnalyticRun(), tmp_path / "cameras.json")] == ["a", "b"]


def test_cameras_that_see_nothing_are_warned_of(tmp_path, logged, monkeypatch):
    run = AnalyticRun()
    rendered = run.render

    def nothing(view, **options):
        image = rendered(view, **options)
        image.alpha.mul_(0.001)
        return image

    monkeypatch.setattr(run, "render", nothing)
    render_views(run, tmp_path)
    assert any("2 of 2 cameras (t_0, t_1) see nothing" in line for line in logged)


def test_stops_count_from_the_median_exposure_of_photos_that_differ(tmp_path, logged):
    run = AnalyticRun()
    render_views(run, tmp_path / "one", evs=(-1, 0))
    assert not any("0 EV" in line for line in logged)
    for entry, time in zip(run.cameras, (0.5, 1 / 60, 2.0), strict=False):
        entry.exposure_time = time
    render_views(run, tmp_path / "mixed", evs=(-1, 0))
    expected = "0 EV of the brackets is 0.5 s, the photos' median exposure; their times are 1/60 s to 2 s"
    assert expected in logged
    run.exposure_compensation = ExposureCompensation({entry.name: (1.0, 1.1, 1.0) for entry in run.cameras}, {})
    run.base_time = 0.55
    render_views(run, tmp_path / "drift", evs=(-1, 0))
    assert expected.replace("0.5 s", "0.55 s").replace("exposure;", "exposure corrected for drift;") in logged
