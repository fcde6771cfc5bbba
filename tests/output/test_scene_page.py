"""The page to send, in a real browser and from disk: the light is that of our own renders."""

import base64
import json
import re
import time
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, UsageError
from sehdr_warp.model.baking import field_of
from sehdr_warp.model.pixel_filter import FocalRange
from sehdr_warp.output.export.commands import Export, run_export
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.export.splat_edits import SplatEdits
from sehdr_warp.output.images.display import display_gain, encode_srgb
from sehdr_warp.output.scene_page import write_scene_page
from sehdr_warp.output.world_transform import world_transform
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.run import Splats, load_splats
from sehdr_warp.scene import Camera
from sehdr_warp.splats.arrays import HARMONIC_0
from sehdr_warp.training.train import train

from ..training.toy import toy_scene
from ..viewer.browser import browser, page_of, pinch, pixels
from .helpers import Entry, camera, run_of, splats

FULL = "#stage[data-frame=full]"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    config = {"schedule.iterations": 60, "plan.enabled": False}
    return train(toy_scene(), tmp_path_factory.mktemp("toy") / "run", config, device="cpu")


def test_the_page_shows_the_light_of_the_scene(run, tmp_path):
    file = write_scene_page(run, tmp_path / "scene.html")
    assert file.stat().st_size < 30e6
    with browser() as chromium, page_of(chromium, file.as_uri(), 240, 200) as page:
        started = time.monotonic()
        page.wait_for_selector(FULL)
        loaded = time.monotonic() - started
        assert page.text_content("#status") == page.title() and f"{page.title()} &middot; loading<" in file.read_text()
        camera = Camera.from_dict(page.evaluate("document.getElementById('stage').pose"))
        exposure = run.render(camera).hdr.cpu().numpy() * run.base_time
        error = pixels(page, "#picture") - run.response.encode(exposure)
        assert -10 * np.log10(np.mean(error**2)) > 38
        page.select_option("#tone", "none")
        light = exposure * display_gain(run.response)
        for stops in (-4, 0, 3):
            page.locator("#stops").evaluate(
                "(s, v) => { s.value = v; s.dispatchEvent(new Event('input')); }", str(stops)
            )
            error = pixels(page, "#picture") - encode_srgb(light * 2.0**stops)
            assert -10 * np.log10(np.mean(error**2)) > 38, stops
        assert "EV" in page.text_content("#stopsLabel") and loaded < 30  # In software, on a machine with other work
        page.locator("#stage").evaluate("stage => delete stage.dataset.frame")
        page.mouse.move(100, 80)
        page.mouse.down()
        page.mouse.move(140, 90, steps=3)
        page.mouse.up()
        page.wait_for_selector(FULL)
        assert page.evaluate("document.getElementById('stage').pose.world_to_camera") != camera.world_to_camera.tolist()


def test_refusals(run, tmp_path):
    (tmp_path / "mine.html").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        write_scene_page(run, tmp_path / "mine.html")
    for name, suffix in (("page", "no suffix"), ("page.ply", ".ply"), ("page.html.gz", ".gz")):
        with pytest.raises(InputError, match=rf"{name}: has {suffix}, a page has .html; use .html"):
            write_scene_page(run, tmp_path / name)
    with pytest.raises(UsageError, match="without effect on a page"):
        run_export(Export(run=run.path, out=tmp_path / "new.html", cameras=True))
    assert [file.name for file in tmp_path.iterdir()] == ["mine.html"]


def test_a_file_without_cameras_is_a_page_that_shows_it(run, tmp_path):
    export(run, tmp_path / "s.ply")
    file = write_scene_page(load_splats(tmp_path / "s.ply"), tmp_path / "s.html")
    with browser() as chromium, page_of(chromium, file.as_uri(), 240, 200) as page:
        page.wait_for_selector(FULL)
        assert (pixels(page, "#picture").max(axis=2) > 0.05).mean() > 0.1
        pose = page.evaluate("document.getElementById('stage').pose.world_to_camera")
        page.locator("#stage").evaluate("stage => delete stage.dataset.frame")
        page.keyboard.press("d")  # Before any click
        page.wait_for_selector(FULL)
        assert page.evaluate("document.getElementById('stage').pose.world_to_camera") != pose
        page.keyboard.press("Home")
        page.wait_for_function("pose => JSON.stringify(stage.pose.world_to_camera) === JSON.stringify(pose)", arg=pose)
        for _ in range(3):
            page.keyboard.press("[")
        assert "1.0" in page.text_content("#stopsLabel")


def test_a_part_of_a_file_without_cameras_is_framed(tmp_path):
    random = np.random.default_rng(0)
    places = np.concatenate([random.normal(size=(40, 3)) * 0.2, random.normal(size=(40, 3)) * 0.2 + (8, 0, 0)])
    scene = run_of(tmp_path, splats(places, np.full(80, 0.9), scale=0.05))
    scene.cameras = ()
    x, y, z = world_transform(scene).points(np.array([8.0, 0, 0]))
    file = write_scene_page(scene, tmp_path / "part.html", edits=SplatEdits(crop=f"sphere:{x},{y},{z},2"))
    opening = Camera.from_dict(read_page(file)[0]["opening"])
    _, column, _, inside = opening.project(places[40:])
    assert inside.mean() > 0.8 and np.ptp(column[inside]) > 0.3 * opening.width


@pytest.mark.parametrize("has_cameras", [True, False])
def test_a_page_of_map_coordinates_is_that_of_the_scene_near_the_origin(tmp_path, has_cameras):
    """float32 would move Gaussians of UTM coordinates by up to 0.25 m."""
    random = np.random.default_rng(0)
    places, pages = random.normal(size=(40, 3)), []
    places -= places.mean(0)
    for at in (np.zeros(3), np.array([5e5, 5.4e6, 100.0])):
        gaussians = replace(splats(places, np.full(40, 0.9), scale=0.1), means=places + at)
        views = [camera(position=at + np.array([i, 0, -6]), target=at) for i in range(3)] if has_cameras else []
        entries = tuple(Entry(str(i), "train", view) for i, view in enumerate(views))
        pages.append(write_scene_page(Splats(tmp_path / "s", field_of(gaussians), entries), tmp_path / f"{at[0]}.html"))
    (facts, means), (far_facts, far_means) = map(read_page, pages)
    np.testing.assert_allclose(far_means, means, atol=1e-6)
    assert len(facts["views"]) == len(far_facts["views"]) == (3 if has_cameras else 0)
    cameras = zip(*([each["opening"], *(view["camera"] for view in each["views"])] for each in (facts, far_facts)))
    for near, far in cameras:
        np.testing.assert_allclose(far["world_to_camera"], near["world_to_camera"], atol=1e-5)
    np.testing.assert_allclose(far_facts["focus"], facts["focus"], atol=1e-5)


@pytest.mark.parametrize("response, most, brightest", [("linear", 18515, "4.01e+05"), ("filmic", 1683, "3.64e+04")])
def test_light_beyond_half_floats_is_named_in_whites_of_the_photos(tmp_path, caplog, response, most, brightest):
    lights = np.array([1.0, 1e5, 4e5])
    harmonics = np.tile((lights / HARMONIC_0)[:, None, None], (1, 1, 3)).astype(np.float32)
    gaussians = splats([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [0.9] * 3)
    run = run_of(tmp_path, replace(gaussians, color_model="linear", harmonics=harmonics))
    run.response = response_by_name(response)
    write_scene_page(run, tmp_path / "a.html")
    assert (
        f"a.html: its half floats end at {most} times white; 2 Gaussians are brighter, up to {brightest} times"
        in caplog.text
    )


def read_page(file):
    """Return the facts and the means [3, N] of a page."""
    text = file.read_text()
    facts = json.loads(re.search(r'id="facts">(.*?)</script>', text)[1])
    packed = re.search(r'id="means">(.*?)</script>', text)[1]
    return facts, np.frombuffer(zlib.decompress(base64.b64decode(packed)), "<f4").reshape(3, -1)


def test_two_fingers_come_nearer_and_one_turns(run, tmp_path):
    file = write_scene_page(run, tmp_path / "scene.html")
    with browser() as chromium, page_of(chromium, file.as_uri(), 240, 200, has_touch=True) as page:
        page.wait_for_selector(FULL)
        hint, panel = (page.locator(f"#{name}").bounding_box() for name in ("hint", "panel"))
        assert hint["x"] >= 0 and hint["x"] + hint["width"] <= 240 and hint["y"] + hint["height"] < panel["y"]
        ahead, pivot = page.evaluate("[camera.ahead, camera.pivot]")
        pinch(page, [(100, 80), (120, 80)], [(90, 80), (130, 80)])
        until = "ahead => Math.abs(camera.ahead / ahead - 0.5) < 1e-6"
        page.wait_for_function(until, arg=ahead)
        # Fingers are told one after the other, so their middle moves a little on the way.
        np.testing.assert_allclose(page.evaluate("camera.pivot"), pivot, atol=0.05 * ahead)
        pivot = page.evaluate("camera.pivot")
        pinch(page, [(100, 80)], [(140, 90)])  # One finger, as before: about the same point
        page.wait_for_function("pivot => Math.hypot(...add(camera.pivot, pivot, -1)) < 1e-6", arg=pivot)
        assert page.evaluate("camera.ahead") == pytest.approx(ahead / 2)
        page.wait_for_selector(FULL)


def test_gaussians_beyond_the_picture_are_drawn_as_ours_are(tmp_path):
    """Larger than the picture, far off its axis, and nearer than the near plane: fog in front of a camera."""
    # The nearest first, because the engine does not order so few.
    gaussians = splats([(0, 0, -5.993), (0.5, 0, -5.6), (0, 0, -5), (0, 0, 0)], [0.9, 0.6, 0.3, 0.9])
    gaussians.harmonics[:] *= np.float32([8, 2, 1, 4])[:, None, None]
    sizes = np.log([[0.01] * 3, [0.3] * 3, [6, 2, 0.5], [0.3] * 3]).astype(np.float32)
    run = run_of(tmp_path, replace(gaussians, log_scales=sizes, color_model="linear"))
    file = write_scene_page(run, tmp_path / "fog.html")
    with browser() as chromium, page_of(chromium, file.as_uri(), 240, 200) as page:
        page.wait_for_selector(FULL)
        camera = Camera.from_dict(page.evaluate("document.getElementById('stage').pose"))
        exposure = run.render(camera).hdr.cpu().numpy() * run.base_time
        error = pixels(page, "#picture") - run.response.encode(torch.as_tensor(exposure)).cpu().numpy()
        assert exposure.max() > 0.1 and -10 * np.log10(np.mean(error**2)) > 38


def check_page_against_render(scene, file, width, height):
    """Check that the page of a scene shows what its render shows; return the page's camera and that render."""
    write_scene_page(scene, file)
    with browser() as chromium, page_of(chromium, file.as_uri(), width, height) as page:
        page.wait_for_selector(FULL)
        camera_of_page = Camera.from_dict(page.evaluate("document.getElementById('stage').pose"))
        picture = pixels(page, "#picture")
    rendered = scene.render_ldr(camera_of_page).numpy()
    assert -10 * np.log10(np.mean((picture - rendered) ** 2)) > 50
    return camera_of_page, rendered


@pytest.mark.parametrize("photos", [FocalRange(40.0, 40.0), None])
def test_a_page_that_is_wider_than_the_photos_has_their_projection(tmp_path, photos):
    beside = replace(splats([(0.9, 0, -2.6), (0, 0, 0)], [0.9, 0.9], scale=0.12), color_model="linear")
    beside.harmonics[:, 0] = 2.0
    field = field_of(beside)
    field.photo_focals = photos
    scene = Splats(tmp_path / "beside", field, (Entry("0", "train", camera()),))
    camera_of_page, rendered = check_page_against_render(scene, tmp_path / "beside.html", 700, 140)
    assert camera_of_page.width / camera_of_page.fx > 2 and rendered.max() > 0.5


@pytest.mark.parametrize(("focal", "antialiased"), [(75.0, False), (600.0, False), (None, False), (None, True)])
def test_lamps_smaller_than_a_pixel_keep_their_light(tmp_path, focal, antialiased):
    """The page is four times larger than the photos, half as large, of photos that are not known, and compensated."""
    places = np.random.default_rng(0).uniform(-1, 1, (60, 3)) * (1.2, 0.8, 1)
    lamps = replace(splats(places, np.full(60, 0.6), scale=0.004), color_model="linear", antialiased=antialiased)
    lamps.harmonics[:, 0] = 2.0
    field = field_of(lamps)
    field.photo_focals = focal and FocalRange(focal, focal)
    scene = Splats(tmp_path / "lamps", field, (Entry("0", "train", camera()),))
    camera_of_page, _ = check_page_against_render(scene, tmp_path / "lamps.html", 240, 200)
    assert camera_of_page.fx == pytest.approx(300)
