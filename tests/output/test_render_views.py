import json
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.cameras.paths import interpolate, orbit
from sehdr_warp.output.cameras.scene_cameras import common_focus
from sehdr_warp.output.cameras.selection import select_cameras
from sehdr_warp.output.images.display import display_gain
from sehdr_warp.output.render_views import render_views
from sehdr_warp.own_files import LIST
from sehdr_warp.scene import Camera, load_cameras
from sehdr_warp.scene.exposure.compensation import ExposureCompensation
from sehdr_warp.scene.file_names import safe_names

from .helpers import AnalyticRun, Entry, camera, read_exr


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
        assert any(line.startswith(f"{tmp_path / name}: stays, though") for line in logged)


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


def test_names_are_safe_and_different():
    names = ["a/b", "..", "A_B", "a_b", "x" * 300, "con?", "a_b_2", ""]
    safe = safe_names(names)
    assert safe == ["a_b", "view", "A_B_3", "a_b_4", "x" * 120, "con_", "a_b_2", "view_2"]
    assert len({name.casefold() for name in safe}) == len(safe)


def arc(count, degrees, radius=3.0, height=-0.5):
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, count, endpoint=degrees < 360))
    return [camera(position=(radius * np.sin(a), height, -radius * np.cos(a))) for a in angles]


def sees(view, point):
    x, y, z, _ = view.world_to_camera @ np.append(point, 1)
    return view.fx * x / z + view.cx, view.fy * y / z + view.cy


@pytest.mark.parametrize("degrees", [60, 360])
def test_orbit_looks_at_the_focus_smoothly(degrees):
    camera_path = arc(12, degrees)
    path = orbit(camera_path, 48, 1)
    positions = np.stack([view.position for view in path])
    for view in path:
        np.testing.assert_allclose(sees(view, np.zeros(3)), (view.cx, view.cy), atol=1e-6)
        assert view.world_to_camera[1, :3] @ [0, 1, 0] > 0.9
        np.testing.assert_allclose(np.linalg.norm(view.position), np.linalg.norm(camera_path[0].position), rtol=1e-6)
    steps = np.linalg.norm(np.diff(positions, axis=0, append=positions[:1]), axis=1)
    assert steps.max() < 4 / len(path) * np.ptp(positions, axis=0).max()
    azimuth = np.degrees(np.arctan2(positions[:, 0], -positions[:, 2]))
    assert np.ptp(azimuth) > 300 if degrees == 360 else np.abs(azimuth).max() < 30


def test_orbit_of_parallel_cameras_uses_the_depth_seen():
    run = AnalyticRun()
    run.cameras = [
        Entry(str(i), "train", camera(position=(x, 0, -3), target=(x, 0, 0))) for i, x in enumerate((0, 0.2, 0.4))
    ]
    views = select_cameras(run, "orbit", count=8)
    assert [name for name, _ in views] == [f"orbit_{i:03d}" for i in range(8)]
    for _, view in views:  # AnalyticRun's depth is 2 everywhere: the focus lies at z = -1.
        np.testing.assert_allclose(sees(view, (0.2, 0, -1)), (view.cx, view.cy), atol=0.1)


def test_interpolation_passes_through_its_cameras():
    camera_path = arc(5, 90)
    path = interpolate(camera_path, 41)
    assert len(path) == 41
    for i, view in enumerate(camera_path):
        np.testing.assert_allclose(path[10 * i].world_to_camera, view.world_to_camera, atol=1e-6)
    turns = [np.linalg.norm(a.world_to_camera - b.world_to_camera) for a, b in pairwise(path)]
    assert max(turns) < 1.5 * min(turns)
    repeated = interpolate([camera_path[0], camera_path[0], camera_path[1]], 3)
    np.testing.assert_allclose(repeated[2].world_to_camera, camera_path[1].world_to_camera, atol=1e-9)
    assert len(interpolate(camera_path[:1], 4)) == 4


def test_paths_need_cameras(tmp_path):
    with pytest.raises(SehdrError, match=r"no training views.*file of cameras"):
        interpolate([], 3)
    for choice in ("test", "all", "orbit"):  # As of a file of Gaussians without a file of cameras beside it
        with pytest.raises(SehdrError, match=rf"no cameras of its own, and {choice} needs them; .*which export writes"):
            render_views(AnalyticRun([]), tmp_path / "out", cameras=choice)
    with pytest.raises(SehdrError, match="no cameras, and so no view 'r_0'"):
        render_views(AnalyticRun([]), tmp_path / "out", camera="r_0")
    with pytest.raises(SehdrError, match="path cannot have 0 views"):
        orbit(arc(3, 30), 0, 1)


def test_aovs_are_parts_of_their_own(tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR")
    run = AnalyticRun()
    render_views(run, tmp_path, aovs="all", axes="scene")
    view, rendered = run.cameras[3].camera, run.render(run.cameras[3].camera)
    with OpenEXR.File(str(tmp_path / "hdr" / "t_0.exr"), separate_channels=True) as file:
        headers = {part.name(): dict(part.header) for part in file.parts}
        pixels = {name: channel.pixels for part in file.parts for name, channel in part.channels.items()}
    assert {pixels[f"N.{axis}"].dtype for axis in "XYZ"} == {np.dtype(np.float16)}
    assert list(headers) == ["rgba", "depth", "position", "normals", "alpha", "confidence", "clipped"]
    assert headers.pop("rgba")["colorInteropID"] == "lin_rec709_scene"
    assert all(h["colorInteropID"] == "data" and "chromaticities" not in h for h in headers.values())
    points = np.stack([pixels[f"position.{axis}"] for axis in "XYZ"], 2)
    np.testing.assert_allclose(np.linalg.norm(points - view.position, axis=2), pixels["distance.Z"], rtol=1e-5)
    np.testing.assert_allclose((points - view.position) @ view.world_to_camera[2, :3], rendered.depth, rtol=1e-5)
    # A plane across the view, nearly: its normal is against the axis.
    normal = np.stack([pixels[f"N.{axis}"] for axis in "XYZ"], 2)[1:-1, 1:-1]
    np.testing.assert_allclose(normal @ -view.world_to_camera[2, :3], 1, atol=2e-3)
    assert (pixels["clipped"] == 0.25).all()
    run.confident = False
    for name in ("clipped", "confidence"):
        with pytest.raises(SehdrError, match=f"AOV {name} was not measured"):
            render_views(run, tmp_path, aovs=name, overwrite=True)
    for aovs, words in (("depht", "did you mean depth"), ("alpha,alpha", "named twice")):
        with pytest.raises(SehdrError, match=words):
            render_views(run, tmp_path, aovs=aovs, overwrite=True)


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


def test_common_focus_is_where_the_axes_meet():
    np.testing.assert_allclose(common_focus(arc(5, 60)), 0, atol=1e-9)
    parallel = [camera(position=(x, 0, -3), target=(x, 0, 0)) for x in (0, 0.1, 0.2)]
    assert common_focus(parallel) is None
    away = [camera(position=(x, 0, -3), target=(3 * x, 0, -9)) for x in (-1.0, -0.5, 0.5, 1.0)]
    assert common_focus(away) is None


def test_orbit_follows_an_arc_that_goes_up_and_down():
    # A hand-held walk over a mound and around a corner: higher and farther away in the middle.
    angles = np.radians(np.linspace(-34, 34, 10))
    heights, distances = 0.6 - 9 * (angles - 0.1) ** 2 / 4, 12 - 5 * angles**2
    camera_path = [
        camera(position=(d * np.sin(a), -h, -d * np.cos(a))) for a, h, d in zip(angles, heights, distances, strict=True)
    ]
    for view in orbit(camera_path, 48, 1):
        x, y, z = view.position
        near = np.argsort(np.abs(angles - np.arctan2(x, -z)))[:2]
        assert heights[near].min() - 0.05 < -y < heights[near].max() + 0.05
        assert distances[near].min() - 0.1 < np.hypot(x, z) < distances[near].max() + 0.1


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
