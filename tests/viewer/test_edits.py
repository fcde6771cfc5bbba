"""Edits in the viewer: crops, gains of lights, up and scale."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from sehdr_warp.model.light_shapes import LightShape
from sehdr_warp.model.lights import Light
from sehdr_warp.output.export.splat_edits import SplatEdits
from sehdr_warp.output.world_transform import world_transform
from sehdr_warp.scene import Camera, View
from sehdr_warp.scene.normalization import Normalization
from sehdr_warp.viewer.server import Viewer
from sehdr_warp.viewer.viewer_scene import ViewerScene
from tests.output.helpers import run_of, splats

from .browser import browser, page_of
from .conftest import serving
from .test_page import until
from .test_server import ask, frame


@pytest.fixture
def server(tmp_path):
    """A viewer of two Gaussians, in a folder that keeps an orientation."""
    run = run_of(tmp_path, splats([(0, 0, 0), (1, 0, 0)], [0.9, 0.9]))
    run.path = tmp_path
    with serving(Viewer([ViewerScene(run, "run")]), 18400) as server:
        yield server


@pytest.fixture
def lamps(tmp_path):
    """A viewer of two Gaussians, of which the second is a light."""
    run = run_of(tmp_path, replace(splats([(-1, 0, 0), (1, 0, 0)], [0.9, 0.9]), color_model="log"), "lamps")
    run.path = tmp_path
    shape = LightShape("sphere", np.array([1.0, 0, 0]), np.eye(3), (0.3, 0.3))
    run.find_lights = lambda: [Light(shape, np.full(3, 8.0), np.ones(3), 0.75, 0.4, torch.tensor([1]))]
    with serving(Viewer([ViewerScene(run, "run", torch.tensor([0.0, 1.0]))]), 18500) as server:
        yield server


def test_a_light_is_listed_and_made_brighter(lamps):
    view = lamps.viewer.runs[0].cameras[1].camera
    before = frame(lamps, view)[0]
    light_list = json.loads(ask(lamps, "/lights", {})[2])
    assert light_list["unit"] is None and light_list["lights"][0] == {
        "name": "light_0",
        "position": [1, 0, 0],
        "size": 0.3,
        "radiance": 8,
        "certain": 1,
        "deviation": 0.75,
        "share": 0.4,
        "stops": 0,
    }
    status, _, content = ask(lamps, "/gain", {"light": 0, "stops": 2})
    assert status == 200 and json.loads(content)["lights"][0]["stops"] == 2
    ratio = frame(lamps, view)[0][..., :3] / np.maximum(before[..., :3], 1e-6)
    half = view.width // 2
    sides = sorted(float(np.median(side[side > 0])) for side in (ratio[:, :half], ratio[:, half:]))
    assert sides == pytest.approx([1, 4], rel=0.01)
    ask(lamps, "/gain", {"light": 0, "stops": 1})  # Of what was trained, not of the last gain.
    assert frame(lamps, view)[0][..., :3].max() == pytest.approx(2 * before[..., :3].max(), rel=0.01)
    assert ask(lamps, "/gain", {"light": 0, "stops": 0})[0] == 200
    np.testing.assert_array_equal(frame(lamps, view)[0], before)


def test_gains_that_cannot_be_are_refused(lamps, server):
    for request in ({"light": 1, "stops": 1}, {"light": 0, "stops": 99}, {"light": -1, "stops": 1}):
        assert ask(lamps, "/gain", request)[0] == 409
    assert ask(lamps, "/gain", {"light": 0})[0] == 400
    assert json.loads(ask(server, "/lights", {})[2])["lights"] == []  # Nothing states what clipped.
    status, _, words = ask(server, "/gain", {"light": 0, "stops": 1})
    assert status == 409 and b"gains need radiance" in words


def test_the_page_flies_to_a_light_and_sets_its_gain(lamps):
    move = "range => ['input', 'change'].forEach(name => { range.value = 3; range.dispatchEvent(new Event(name)); })"
    with browser() as chromium, page_of(chromium, lamps.url) as page:
        page.wait_for_selector("#stage[data-frame=full]")
        page.click("#findLights")
        page.click(".light button")
        page.evaluate(
            "async () => { while (!(Math.abs(camera.pivot[0] - 1) < 1e-6)) await new Promise(requestAnimationFrame); }"
        )
        page.wait_for_selector("#stage[data-frame=full]")
        listed = page.text_content(".light")
        assert "light_0: 40 % of the light" in listed and "0.8 stops" in listed
        page_camera = Camera.from_dict(page.evaluate("window.viewer.camera()"))
        x, y, z, _ = page_camera.world_to_camera @ np.array([1, 0, 0, 1])
        assert z > 0 and abs(x) < 1e-6 and abs(y) < 1e-6
        with page.expect_response("**/gain") as answer:
            page.locator(".light input").evaluate(move)
        assert answer.value.ok and page.text_content(".light output") == "+3.0 EV"
    assert lamps.viewer.runs[0].describe_lights()["lights"][0]["stops"] == 3


def edit(server, **request) -> tuple[int, Any]:
    status, _, content = ask(server, "/edit", request)
    return status, json.loads(content) if status == 200 else content.decode()


def test_a_crop_is_shown_and_undone(server):
    scene = server.viewer.runs[0]
    view, version = scene.cameras[1].camera, scene.version
    before = frame(server, view)[0]
    x, y, z = world_transform(scene).points(np.array([1.0, 0, 0]))
    status, facts = edit(server, cut=f"sphere:{x},{y},{z},0.2")
    assert status == 200 and facts["gaussians"] == 1 and facts["edited"] and facts["version"] > version
    assert not np.allclose(frame(server, view)[0], before)
    status, words = edit(server, crop="sphere:99,0,0,1")
    assert status == 409 and "leave no Gaussian" in words
    assert edit(server, crop="ball")[0] == 409
    status, facts = edit(server)
    assert facts["gaussians"] == 2 and not facts["edited"]
    np.testing.assert_array_equal(frame(server, view)[0], before)


def test_regions_are_those_of_a_scene_that_is_trained_in_other_coordinates(tmp_path):
    run = run_of(tmp_path, splats([(0, 0, 0), (1, 0, 0)], [0.9, 0.9]))
    run.path, run.field.normalization = tmp_path, Normalization(np.array([0.5, 0, 0]), 4.0)
    with torch.no_grad():
        run.field.gaussians.means.sub_(torch.tensor([0.5, 0, 0])).div_(4)
    scene = ViewerScene(run, "run")
    x, y, z = world_transform(run).points(np.array([1.0, 0, 0]))
    scene.edit(SplatEdits(cut=f"box:{x - 0.2},{y - 0.2},{z - 0.2},{x + 0.2},{y + 0.2},{z + 0.2}"))
    assert (torch.sigmoid(run.field.gaussians.opacity_logits) > 0.1).flatten().tolist() == [True, False]


def test_floaters_faint_and_unmasked_gaussians_are_left_out(tmp_path):
    """Each edit counts on the whole scene, whatever the one before it hid."""
    run = run_of(tmp_path, splats([(0, 0, 0), (1, 0, 0), (0, 0, -20)], [0.9, 0.5, 0.9]))
    run.path, photo = tmp_path, run.cameras[2].camera
    x, _, z, _ = photo.world_to_camera @ np.array([0.5, 0, 0, 1])
    beyond = np.arange(photo.width) > photo.fx * x / z + photo.cx
    codes = np.zeros((photo.height, photo.width, 3), np.uint8)
    mask = np.tile(np.float32(beyond), (photo.height, 1))
    photos = {"2": View("2", codes, photo, 1.0, "train", mask)}
    with serving(Viewer([ViewerScene(run, "run")], lambda index: photos), 18600) as server:
        logits = run.field.gaussians.opacity_logits

        def shown(**request):
            assert edit(server, **request)[0] == 200
            return (torch.sigmoid(logits) > 0.1).flatten().tolist()

        x, y, z = world_transform(run).points(np.zeros(3))
        assert shown(cut=f"sphere:{x},{y},{z},0.2") == [False, True, True]
        assert shown(min_views=2) == [True, True, False]
        assert shown(min_opacity=0.6) == [True, False, True]
        assert sum(shown(mask_only=True)) == 1
        assert edit(server, min_opacity=0.95)[0] == 409
        assert sum(shown()) == 3


def test_masks_that_are_not_there_are_named(server):
    status, words = edit(server, mask_only=True)
    assert status == 409 and "photos" in words


def test_up_and_scale_are_kept_with_the_run(server, tmp_path):
    status, _, content = ask(server, "/orientation", {"up": [0, 0, 1]})
    assert status == 200 and np.allclose(np.array(json.loads(content)["upright"])[1, :3], [0, 0, 1])
    assert ask(server, "/orientation", {"scale": 0.25})[0] == 200
    orientation = json.loads((tmp_path / "orientation.json").read_text())
    assert orientation == {"up": [0, 0, 1], "scale": 0.25}
    for request in ({"scale": -1}, {"up": [0, 0, 0]}, {"up": [1]}):
        assert ask(server, "/orientation", request)[0] == 409
    assert json.loads((tmp_path / "orientation.json").read_text()) == orientation


def test_the_button_saves_a_page_that_opens_with_the_same_view(server, tmp_path):
    with browser() as chromium:
        with page_of(chromium, server.url) as page:
            page.wait_for_selector("#stage[data-frame=full]")
            assert page.text_content("#share") == "Page to share"
            place = page.evaluate("window.viewer.camera()")["world_to_camera"]
            with page.expect_download() as download:
                page.click("#share")
            name = download.value.suggested_filename
            download.value.save_as(tmp_path / "shared.html")
            page.locator("#saved", has_text="saved by your browser").wait_for()
            assert name == f"{page.evaluate('facts.scene')}.html"
        with page_of(chromium, (tmp_path / "shared.html").as_uri(), 240, 200) as page:
            page.wait_for_selector("#stage[data-frame=full]")
            np.testing.assert_allclose(page.evaluate("stage.pose.world_to_camera"), place, atol=1e-6)


def test_undo_goes_back_one_edit_at_a_time(server):
    """And lengths are in units until the scale is set, then in meters."""
    with browser() as chromium, page_of(chromium, server.url) as page:
        page.wait_for_selector("#stage[data-frame=full]")

        def pick(*points):
            page.evaluate("points => { state.points = points; measured(); }", list(points))

        def edit(button, count, words):
            page.click(button)
            until(page, f"facts.gaussians === {count} && $('edited').textContent.includes('{words}')")

        pick((1, 0, 0), (1.2, 0, 0))
        assert page.inner_text("#distance") == "0.200 units"
        edit("#cut", 1, "--cut sphere:")
        pick((0, 0, 0), (0.5, 0, 0))
        edit("#crop", 1, "--crop sphere:")
        edit("#undo", 1, "part.ply --cut")
        assert "--crop" not in page.inner_text("#edited")
        edit("#undo", 2, "all of it is shown")
        pick((1, 0, 0), (1.2, 0, 0))
        page.select_option("#shape", "box")
        edit("#cut", 1, "--cut box:")
        edit("#floaters", 1, "--min-views 2")
        page.click("#floaters")  # Again, and the next click does not wait for it.
        edit("#undo", 1, "--min-views 2")
        edit("#undo", 1, "--cut box:")
        edit("#undo", 2, "all of it is shown")
        assert page.locator("#undo").is_disabled()
        pick((0, 0, 0), (0.5, 0, 0))
        page.fill("#meters", "2")
        page.click("#setScale")
        until(page, "$('edited').textContent.includes('kept: 4')")
        pick((0, 0, 0), (0.5, 0, 0))
        assert page.inner_text("#distance") == "2.00 m"


def test_pages_of_one_server_share_edits_and_undo(server):
    with browser() as chromium, page_of(chromium, server.url) as one, page_of(chromium, server.url) as other:

        def until_told(page, count, words):
            until(page, f"facts.gaussians === {count} && $('edited').textContent.includes('{words}')")

        for page in (one, other):
            page.wait_for_selector("#stage[data-frame=full]")
        one.click("#floaters")
        until_told(one, 2, "--min-views 2")
        other.evaluate("state.points = [[1, 0, 0], [1.2, 0, 0]], measured()")
        other.click("#cut")  # At once, or when the page has seen the other's edit
        until_told(other, 1, "--min-views 2 --cut sphere:")
        until_told(one, 1, "--min-views 2 --cut sphere:")
        one.reload()
        one.wait_for_selector("#stage[data-frame=full]")
        assert "--min-views 2 --cut sphere:" in one.inner_text("#edited")
        one.click("#undo")
        until_told(one, 2, "part.ply --min-views 2")
        other.click("#undo")
        until_told(other, 2, "all of it is shown")
        until_told(one, 2, "all of it is shown")
        assert server.viewer.runs[0].facts()["history"] == [{}]


@pytest.mark.parametrize(
    "history", ["cut", [], ["cut"], [{"cut": "ball"}], [{"cut": {"shape": "ball", "points": [[0] * 3] * 2}}],
                [{"cut": {"shape": "box", "points": [[0] * 3]}}], [{"merge": ["0"]}]]
)  # fmt: skip
def test_edits_that_no_page_draws_are_refused(server, history):
    assert edit(server, min_views=2, history=history)[0] == 409
    assert server.viewer.runs[0].facts()["history"] == [{}]


@pytest.fixture
def two_runs(tmp_path):
    """A viewer of two runs in the same coordinates, of two Gaussians and one."""
    north = run_of(tmp_path, splats([(0, 0, 0), (1, 0, 0)], [0.9, 0.9]), "north")
    south = run_of(tmp_path, splats([(-1, 0, 0)], [0.9]), "south")
    scenes = [ViewerScene(run, f"runs/{run.scene_name}") for run in (north, south)]
    with serving(Viewer(scenes), 18700) as server:
        yield server


def test_another_run_is_merged_edited_and_taken_out_again(two_runs):
    north, south = two_runs.viewer.runs
    view = north.cameras[1].camera
    before, other = frame(two_runs, view)[0], south.run.render(view)
    views = north.facts()["views"]
    status, facts = edit(two_runs, merge=[1])
    assert status == 200 and facts["gaussians"] == 3 and facts["edited"] and facts["merged"] == 1
    assert facts["views"] == views, "photos stay those of the run"
    merged, covered = frame(two_runs, view)[0], np.asarray(other.alpha) > 0.5
    assert covered.any() and np.allclose(merged[covered][:, :3], np.asarray(other.hdr)[covered], atol=5e-3)
    x, y, z = world_transform(north).points(np.array([-1.0, 0, 0]))
    status, facts = edit(two_runs, merge=[1], crop=f"sphere:{x},{y},{z},0.2")
    assert status == 200 and facts["gaussians"] == 1
    # What is refused leaves everything as it was.
    of_crop = frame(two_runs, view)[0]
    status, words = edit(two_runs, crop="sphere:99,0,0,1")
    assert status == 409 and "leave no Gaussian" in words and north.facts()["gaussians"] == 1
    np.testing.assert_array_equal(frame(two_runs, view)[0], of_crop)
    assert edit(two_runs)[1]["gaussians"] == 2
    np.testing.assert_array_equal(frame(two_runs, view)[0], before)


def test_an_edited_run_takes_in_another_as_a_whole(two_runs):
    north, south = two_runs.viewer.runs
    x, y, z = world_transform(north).points(np.array([1.0, 0, 0]))
    assert edit(two_runs, cut=f"sphere:{x},{y},{z},0.2")[1]["gaussians"] == 1
    assert edit(two_runs, merge=[1])[1]["gaussians"] == 3
    assert (torch.sigmoid(north.field.gaussians.opacity_logits) > 0.5).all()
    status, words = edit(two_runs, run=1, merge=[0])
    assert status == 409 and words == "runs/north: has edits of its own; undo these first"
    assert edit(two_runs, merge=[0])[0] == 409 and edit(two_runs, merge=[2])[0] == 404
    assert north.facts()["gaussians"] == 3 and south.facts()["gaussians"] == 1


def test_gains_end_where_a_run_is_merged(two_runs, tmp_path):
    north = two_runs.viewer.runs[0]
    run = run_of(tmp_path, replace(splats([(0, 0, 0)], [0.9]), color_model="log"), "lamp")
    shape = LightShape("sphere", np.zeros(3), np.eye(3), (0.3, 0.3))
    run.find_lights = lambda: [Light(shape, np.full(3, 8.0), np.ones(3), 0.75, 0.4, torch.tensor([0]))]
    north.replace(run, torch.tensor([1.0]))
    view = run.cameras[1].camera
    before = frame(two_runs, view)[0]
    assert ask(two_runs, "/gain", {"light": 0, "stops": 3})[0] == 200
    assert edit(two_runs, merge=[1])[0] == 200 and not north.facts()["clipped"]
    assert edit(two_runs)[0] == 200 and north.facts()["clipped"]
    np.testing.assert_array_equal(frame(two_runs, view)[0], before)


def test_the_page_merges_shares_and_undoes(two_runs, tmp_path):
    two_runs.viewer.runs[1].name = "runs/the south"  # Commands are to be pasted into a shell.
    with browser() as chromium, page_of(chromium, two_runs.url) as page:
        page.wait_for_selector("#stage[data-frame=full]")

        def until_told(count, words):
            until(page, f"facts.gaussians === {count} && $('edited').textContent.includes({words!r})")

        page.select_option("#merge", "1")
        until_told(3, "part.ply --merge 'runs/the south'")
        assert page.evaluate("$('merge').value") == "" and page.locator("#merge option:disabled").count() == 2
        page.click("#floaters")
        until_told(3, "--merge 'runs/the south' --min-views 2")
        with page.expect_download() as download:
            page.click("#share")
        download.value.save_as(tmp_path / "both.html")
        page.click("#undo")
        until_told(3, "part.ply --merge 'runs/the south'")
        page.select_option("#run", "1")  # Edits are those of a run.
        until(page, "facts.name === 'runs/the south' && !facts.edited && $('undo').disabled")
        page.select_option("#run", "0")
        page.click("#undo")
        until_told(2, "all of it is shown")
        page.select_option("#merge", "1")
        until_told(3, "--merge")
    assert (tmp_path / "both.html").stat().st_size > 1e6
