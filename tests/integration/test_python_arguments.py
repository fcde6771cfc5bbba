"""Arguments from Python of another kind than a function takes: the error names them, and nothing is written."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sehdr_warp as sw


@pytest.fixture(scope="module")
def run(embedded_run):
    return sw.load_run(embedded_run)


@pytest.fixture(scope="module")
def scene():
    return sw.load_scene("embedded", max_size=24)


PATHS = {
    "load_scene": lambda run, scene, path: sw.load_scene(path),
    "load_cameras": lambda run, scene, path: sw.load_cameras(path),
    "load_run": lambda run, scene, path: sw.load_run(path),
    "load_splats": lambda run, scene, path: sw.load_splats(path),
    "train": lambda run, scene, path: sw.train(scene, path, "demo"),
    "render_views": lambda run, scene, path: sw.render_views(run, path),
    "write_brackets": lambda run, scene, path: sw.write_brackets(path, {"a": np.ones((2, 2, 3))}, 1.0, evs=[0]),
    "write_environment_map": lambda run, scene, path: sw.write_environment_map(run, path),
    "export": lambda run, scene, path: sw.export(run, path),
    "write_scene_page": lambda run, scene, path: sw.write_scene_page(run, path),
    "write_lights": lambda run, scene, path: sw.write_lights(run, path),
    "write_film": lambda run, scene, path: sw.write_film(run, path, [run.cameras[0].camera]),
    "write_proxy_mesh": lambda run, scene, path: sw.write_proxy_mesh(run, path),
    "write_report": lambda run, scene, path: sw.write_report(run, scene, path),
    "evaluate_folder": lambda run, scene, path: sw.evaluate_folder(path, scene),
    "calibrate": lambda run, scene, path: sw.calibrate(path),
}


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("path", [None, 5, ["a.exr"]])
def test_what_is_no_path_is_named(run, scene, name, path):
    with pytest.raises(TypeError, match=r"^(path|out|folder|stack) is .*, expected a path, as text or pathlib.Path$"):
        PATHS[name](run, scene, path)


RUNS = {
    "render_views": lambda value, scene, folder: sw.render_views(value, folder / "x"),
    "export": lambda value, scene, folder: sw.export(value, folder / "x.ply"),
    "write_environment_map": lambda value, scene, folder: sw.write_environment_map(value, folder / "x.exr"),
    "write_report": lambda value, scene, folder: sw.write_report(value, scene, folder / "x"),
    "evaluate": lambda value, scene, folder: sw.evaluate(value, scene),
    "select_cameras": lambda value, scene, folder: sw.select_cameras(value, "orbit"),
    "merge_scenes": lambda value, scene, folder: sw.merge_scenes(value),
}


@pytest.mark.parametrize("name", RUNS)
def test_a_scene_in_place_of_a_run_is_named(scene, tmp_path, name):
    for value, kind in ((scene, "Scene"), (None, "NoneType")):
        with pytest.raises(TypeError, match=rf"a {kind} is not what sehdr_warp.load_run\(\) returns"):
            RUNS[name](value, scene, tmp_path)
    assert not any(tmp_path.iterdir())


def test_a_run_in_place_of_a_scene_is_named(run, tmp_path):
    for call in (
        lambda: sw.train(run, tmp_path / "x"),
        lambda: sw.evaluate(run, run),
        lambda: sw.make_plan(run),
        lambda: sw.match_points(None, 10),
    ):
        with pytest.raises(TypeError, match=r"is not what sehdr_warp.load_scene\(\) returns"):
            call()


LISTS = {
    "candidates is 'srgb', expected a list of names": {"candidates": "srgb"},
    "views is 'r_0', expected a list of names": {"views": "r_0"},
    "cameras has 'cameras.json', expected those of bare photos": {"cameras": "cameras.json"},
    "cameras has 'Camera', expected those of bare photos": {"cameras": "own"},
    "holdout is '8', expected a whole number": {"holdout": "8"},
    "exposure_index is 1.5, expected a whole number": {"exposure_index": 1.5},
    "response is None, expected a name, a file, or what": {"response": None},
}


@pytest.mark.parametrize("words", LISTS)
def test_options_of_load_scene_of_another_type_are_named(run, words):
    options = {name: [run.cameras[0].camera] if value == "own" else value for name, value in LISTS[words].items()}
    with pytest.raises(TypeError, match=words):
        sw.load_scene("embedded", **options)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"max_size": True}, "longest side of True pixels"),
        ({"method": "best"}, "method 'best' is not one of posterior, paper"),
        ({"photo_storage": "ram"}, "photo_storage 'ram' is not one of auto, memory, disk"),
        ({"views": []}, "views is empty; name views"),
        ({"holdout": -1}, "holdout -1 is below 0"),
    ],
)
def test_options_of_load_scene_that_cannot_be_are_named(options, words):
    with pytest.raises(sw.SehdrError, match=words):
        sw.load_scene("embedded", **options)


def test_options_that_train_does_not_take_are_named_as_its_own(scene, tmp_path):
    with pytest.raises(TypeError, match=r"train\(\) got an unexpected keyword argument 'iterations'"):
        sw.train(scene, tmp_path / "x", iterations=5)
    assert not any(tmp_path.iterdir())


def test_compare_runs_takes_a_list(run):
    for value in (run, None):
        with pytest.raises(TypeError, match="expected a list of runs, as load_run"):
            sw.compare_runs(value)


PHOTOS = Path(sw.__file__).parent / "embedded" / "room" / "train"
PICTURE = np.ones((4, 6, 3), np.float32)


def brackets(folder, views=None, **options):
    return sw.write_brackets(folder / "x", {"a": PICTURE} if views is None else views, 1.0, **{"evs": [0]} | options)


OPTIONS = {
    "evs is 2, expected a list of stops, or text with commas": lambda run, to: brackets(to, evs=2),
    "exposures is 0.5, expected a list": lambda run, to: brackets(to, evs=None, exposures=0.5),
    "views is neither a dict of names": lambda run, to: brackets(to, {1: PICTURE}),
    "views is neither a dict": lambda run, to: brackets(to, 5),
    "views is empty; give the radiance of a view": lambda run, to: brackets(to, []),
    "cameras is a list, expected a dict of names and Cameras": lambda run, to: brackets(to, cameras=[1]),
    "camera is a str, expected a Camera": lambda run, to: brackets(to, cameras={"a": "a"}),
    "cameras has 'b', which is not one of the views": lambda run, to: brackets(to, cameras={"b": photo(run)}),
    "the camera of view a is .*, its radiance 6 x 4": lambda run, to: brackets(to, cameras={"a": photo(run)}),
    "response is 'srgb', expected a curve": lambda run, to: brackets(to, ldr="png", response="srgb"),
    "count is '3', expected a whole number": lambda run, to: sw.select_cameras(run, "orbit", count="3"),
    "count is 1.5, expected a whole number": lambda run, to: sw.render_views(run, to / "x", cameras="orbit", count=1.5),
    r"size \(64.5, 48\) is not usable": lambda run, to: sw.render_views(run, to / "x", size=(64.5, 48)),
    "transform is a ndarray, expected what": lambda run, to: sw.select_cameras(run, "test", transform=np.eye(4)),
    "aovs is None, expected a list of names": lambda run, to: sw.render_views(run, to / "x", aovs=None),
    "color space None is not known": lambda run, to: sw.render_views(run, to / "x", colorspace=None),
    "reference_white is '9', expected": lambda run, to: sw.render_views(run, to / "x", reference_white="9"),
    "beyond is '1', expected a number": lambda run, to: sw.write_environment_map(run, to / "x.exr", beyond="1"),
    "degree is '1', expected a whole number": lambda run, to: sw.export(run, to / "x.ply", degree="1"),
    "degree is 1.5, expected a whole number": lambda run, to: sw.export(run, to / "x.ply", degree=1.5),
    r"region \(0, 1\) is not box": lambda run, to: sw.SplatEdits(crop=(0, 1)),
    "min_opacity is '0.5', expected a number": lambda run, to: sw.SplatEdits(min_opacity="0.5"),
    "min_views is 1.5, expected a whole number": lambda run, to: sw.SplatEdits(min_views=1.5),
    "max_gaussians is 1000.0, expected a whole": lambda run, to: sw.SplatEdits(max_gaussians=1e3),
    "mask_views is 'photos', expected views": lambda run, to: sw.SplatEdits(mask_views="photos"),
    r"mask_views is \(CameraEntry.*, expected views": lambda run, to: sw.SplatEdits(mask_views=run.cameras),
    "resolution is '40', expected a whole": lambda run, to: sw.write_proxy_mesh(run, to / "x.obj", resolution="40"),
    "edits is a str, expected SplatEdits": lambda run, to: sw.write_scene_page(run, to / "x.html", edits="crop"),
    r"ev_ramp \('a', 'b'\) is not two numbers": lambda run, to: film(run, to, ev_ramp=("a", "b")),
    "transfer None is not one of": lambda run, to: film(run, to, transfer=None),
    r"times is 1.0, expected a list of seconds": lambda run, to: sw.calibrate(PHOTOS, times=1.0),
    "time '1/2' is not seconds above 0": lambda run, to: sw.calibrate(PHOTOS, times=["1/2"]),
    "time 0 is not seconds above 0; give": lambda run, to: sw.calibrate(PHOTOS, times=[0]),
    "a response decodes values from 0 to 1, not 128": lambda run, to: run.response.decode(np.array([0, 128])),
    "a response takes numbers, not object": lambda run, to: run.response.decode(None),
    "a response takes numbers, not <U3": lambda run, to: run.response.encode("0.5"),
}


def photo(run):
    return run.cameras[0].camera


def film(run, to, **options):
    return sw.write_film(run, to / "x.mp4", [photo(run)] * 2, **options)


@pytest.mark.parametrize("words", OPTIONS)
def test_options_of_outputs_that_cannot_be_are_named(run, tmp_path, words):
    with pytest.raises((TypeError, ValueError, sw.SehdrError), match=words):
        OPTIONS[words](run, tmp_path)
    assert not any(tmp_path.iterdir())


def test_options_of_a_report_that_cannot_be_are_named(run, scene, tmp_path):
    for options, words in (
        ({"view_count": "3"}, "view_count is '3', expected a whole number"),
        ({"view_count": 0}, "view_count 0 is below 1"),
        ({"evaluation": [1]}, "evaluation is a list, expected what evaluate"),
    ):
        with pytest.raises((TypeError, sw.SehdrError), match=words):
            sw.write_report(run, scene, tmp_path / "x", **options)
    assert not any(tmp_path.iterdir())


def test_what_was_not_trained_is_named(run, scene, tmp_path):
    splats = sw.load_splats(sw.export(run, tmp_path / "scene.ply"))
    for value, kind in ((splats, "Splats"), (sw.merge_scenes(run), "MergedScene")):
        for call in (
            lambda value=value: sw.evaluate(value, scene),
            lambda value=value: sw.compare_runs([value]),
            lambda value=value: sw.write_report(value, scene, tmp_path / "x"),
        ):
            with pytest.raises(TypeError, match=rf"{kind} has no training, expected what sehdr_warp.load_run\(\)"):
                call()


def test_a_scene_of_other_cameras_is_named(run, scene, tmp_path, logged):
    sw.evaluate(run, scene)
    assert not any("no camera is that of the run" in line for line in logged)
    turned = [replace(view, camera=scene.views[index - 1].camera) for index, view in enumerate(scene.views)]
    sw.evaluate(run, replace(scene, views=tuple(turned)))
    assert any("no camera is that of the run's view of its name" in line for line in logged)
