"""Arguments from Python of another kind than a function takes: the error names them, and nothing is written."""

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
def test_a_path_that_is_none_is_named(run, scene, name, path):
    with pytest.raises(TypeError, match=r"^(path|out|folder|stack) is .*, expected a path, as text or pathlib.Path$"):
        PATHS[name](run, scene, path)


RUNS = {
    "render_views": lambda value, folder: sw.render_views(value, folder / "x"),
    "export": lambda value, folder: sw.export(value, folder / "x.ply"),
    "write_environment_map": lambda value, folder: sw.write_environment_map(value, folder / "x.exr"),
    "write_report": lambda value, folder: sw.write_report(value, value, folder / "x"),
    "evaluate": lambda value, folder: sw.evaluate(value, value),
    "select_cameras": lambda value, folder: sw.select_cameras(value, "orbit"),
    "merge_scenes": lambda value, folder: sw.merge_scenes(value),
}


@pytest.mark.parametrize("name", RUNS)
def test_a_scene_in_place_of_a_run_is_named(scene, tmp_path, name):
    for value, kind in ((scene, "Scene"), (None, "NoneType")):
        with pytest.raises(TypeError, match=rf"a {kind} is not what sehdr_warp.load_run\(\) returns"):
            RUNS[name](value, tmp_path)
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


def test_compare_runs_takes_a_list(run):
    for value in (run, None, "runs/a"):
        with pytest.raises(TypeError, match="expected a list of runs, as load_run"):
            sw.compare_runs(value)
