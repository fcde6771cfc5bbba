"""The viewer in a real browser: what a lighting artist does, checked on pixels."""

import numpy as np
import pytest

from sehdr_warp.output.images.display import display_gain, encode_srgb
from sehdr_warp.output.notebook import run_html
from sehdr_warp.scene import Camera, View, codes_of

from ..output.helpers import AnalyticRun, read_exr
from .browser import browser, page_of, pixels

FULL = "#stage[data-frame=full]"


@pytest.fixture(scope="module")
def chromium():
    with browser() as chromium_browser:
        yield chromium_browser


def settle(page, action=lambda: None):
    """Waits for the full frame after an action that asks for one."""
    page.wait_for_selector(FULL)
    page.locator("#stage").evaluate("stage => delete stage.dataset.frame")
    action()
    page.wait_for_selector(FULL)


def until(page, condition):
    page.evaluate(f"async () => {{ while (!({condition})) await new Promise(done => setTimeout(done, 20)); }}")


def rest(page):
    """Waits until nothing is asked for any more, nor the photo that is compared with still read."""
    until(page, "stage.dataset.frame === 'full' && !request.busy && (!usesPhoto() || state.photoReady === state.photo)")


def light_of(page, run):
    """Render the page's view here: exposures at 0 EV [H, W, 3], as display light."""
    camera = Camera.from_dict(page.evaluate("window.viewer.camera()"))
    return run.render(camera).hdr.numpy() * run.base_time * display_gain(run.response)


def slide(page, selector, value):
    page.locator(selector).evaluate(
        "(range, value) => { range.value = value; range.dispatchEvent(new Event('input')); }", str(value)
    )


def test_exposure_probe_and_saved_exr_agree(chromium, serve, tmp_path):
    server = serve()
    run = server.viewer.runs[0].run
    with page_of(chromium, server.url) as page:
        page.wait_for_selector(FULL)
        light = light_of(page, run)
        rendered = run.rendered
        np.testing.assert_allclose(
            pixels(page, "#picture"), run.response.encode(light / display_gain(run.response)), atol=2.5 / 255
        )
        page.select_option("#tone", "none")
        for stops in (-3, 0, 2):
            slide(page, "#stops", stops)
            np.testing.assert_allclose(pixels(page, "#picture"), encode_srgb(light * 2.0**stops), atol=2.5 / 255)
        page.fill("#seconds", "1/16")
        page.press("#seconds", "Enter")
        assert page.text_content("#stopsLabel") == "\N{MINUS SIGN}3.0 EV"
        for bad in ("-3", "soon"):
            page.fill("#seconds", bad)
            page.press("#seconds", "Enter")
            assert page.input_value("#seconds") == "1/16 s"
        assert run.rendered == rendered  # Exposure renders nothing.
        page.mouse.move(130, 90)
        probed, probe_text = page.evaluate("window.viewer.probed()"), page.text_content("#probe")
        # Frames are half floats: brighter light is said to be at least the largest of them.
        page.evaluate(
            "light.frames.scene = {...light.frames.scene, half: light.frames.scene.half.map(() => 0x7bff)}, probe()"
        )
        assert page.text_content("#probe").count("\N{GREATER-THAN OR EQUAL TO}") == 3
        with page.expect_download() as download:
            page.click("[data-save=exr]")
        download.value.save_as(tmp_path / "view.exr")
        saved, _, _ = read_exr(tmp_path / "view.exr")
        x, y = 130 / light.shape[1], 90 / light.shape[0]
        np.testing.assert_allclose(probed, saved[int(y * saved.shape[0]), int(x * saved.shape[1]), :3], rtol=0.01)
        assert "radiance" in probe_text and "%" in probe_text and "EV" in probe_text


SLOW = "const ask_ = fetch; fetch = (...all) => new Promise(done => setTimeout(done, 900)).then(() => ask_(...all));"


def test_a_page_whose_scene_is_not_there_yet_says_so_and_takes_no_input(chromium, serve):
    with page_of(chromium, serve(count=2).url, script=SLOW) as page:
        assert page.inner_text("#status") == "the scene is being read …"
        page.keyboard.press("]")
        page.mouse.move(200, 200)
        page.mouse.down()
        page.mouse.move(260, 220)
        page.mouse.up()
        page.wait_for_selector(FULL)
        assert page.input_value("#stops") == "0"
        names = page.evaluate(
            "runs.map((run, i) => { run.name = `/home/me/${'ab'[i]}/scene.ply`; return run; }).map(label)"
        )
        assert names == ["a/scene.ply", "b/scene.ply"]


def test_looks_overlays_and_the_photo_beside(chromium, serve):
    server = serve(count=2)
    run = server.viewer.runs[0].run
    with page_of(chromium, server.url) as page:
        page.wait_for_selector(FULL)
        looks = []
        for tone in ("none", "reinhard", "filmic", "aces", "response"):
            page.select_option("#tone", tone)
            looks.append(pixels(page, "#picture"))
        light = light_of(page, run) / display_gain(run.response)
        np.testing.assert_allclose(looks[4], run.response.encode(light), atol=2.5 / 255)
        page.select_option("#left", "photo")
        rest(page)
        half = pixels(page, "#picture").shape[1] // 2
        beside = pixels(page, "#picture")
        # The photo is of this camera, and what the camera would see is what the scene shows.
        left, outside = slice(0, half - 4), np.full(3, 26 / 255)
        inside = np.abs(beside[:, left] - outside).max(axis=2) > 1 / 255
        assert inside.mean() > 0.3
        assert np.abs(beside[:, left] - looks[4][:, left])[inside].mean() < 0.02
        for overlay in ("stops", "confidence", "depth", "normals", "error", "clipped"):
            page.select_option("#overlay", overlay)
            rest(page)
            looks.append(pixels(page, "#picture"))
        for first in range(len(looks)):
            for second in range(first):
                assert np.abs(looks[first] - looks[second])[:, half + 4 :].mean() > 1e-3, (first, second)
        page.select_option("#overlay", "none")
        settle(page, lambda: page.select_option("#left", "run1"))
        page.check("#frusta")


@pytest.mark.parametrize(
    "lens",
    [
        (512, 256, 512 / (2 * np.pi), "equirectangular", ()),
        (300, 300, 120.0, "OPENCV_FISHEYE", (0.05, -0.02, 0.0, 0.001)),
        (300, 300, 100.0, "SIMPLE_RADIAL_FISHEYE", (-0.1,)),
    ],
    ids=["panorama", "fisheye", "fisheye-with-an-end"],
)
def test_wide_photos_are_compared_with_where_they_show_it(chromium, serve, lens):
    width, height, focal, projection, distortion = lens
    photos = {}
    server = serve(photos=lambda index: photos)
    run = server.viewer.runs[0].run
    for entry in run.cameras:
        pose = entry.camera.world_to_camera
        entry.camera = Camera(width, height, focal, focal, width / 2, height / 2, pose, projection, distortion)
        image = run.response.encode(run.render(entry.camera).hdr.numpy() * entry.exposure_time)
        photos[entry.name] = View(entry.name, codes_of(image, 8), entry.camera, entry.exposure_time, entry.split)
    with page_of(chromium, server.url) as page:
        page.wait_for_selector(FULL)
        settle(page, lambda: page.select_option("#view", "1"))
        scene = pixels(page, "#picture")
        tangent = page.evaluate("(({width, height, fy}) => Math.min(width, height) / 2 / fy)(window.viewer.camera())")
        assert tangent == pytest.approx(np.tan(np.radians(37.5)), rel=1e-3)
        page.select_option("#left", "photo")
        rest(page)
        left = slice(0, scene.shape[1] // 2 - 4)
        beside = pixels(page, "#picture")[:, left]
        visible = np.abs(beside - 26 / 255).max(axis=2) > 1 / 255
        assert visible.mean() > (0.5 if projection == "OPENCV_FISHEYE" else 0.999)
        assert np.abs(beside - scene[:, left])[visible].mean() < 0.02
        page.select_option("#left", "0")
        page.select_option("#overlay", "error")
        rest(page)
        no_error = np.abs(pixels(page, "#picture")[:, left] - [0.10, 0.09, 0.22]).max(axis=2) < 0.1
        assert no_error[visible].mean() > 0.9


def test_the_tables_are_the_shader(chromium, serve):
    looks = [(tone, "none", "0") for tone in ("none", "filmic", "response", "aces", "reinhard")]
    looks += [
        ("none", "stops", "0"),
        ("aces", "clipped", "run1"),
        ("filmic", "stops", "photo"),
        ("none", "none", "photo"),
    ]
    with page_of(chromium, serve(count=2).url) as page:
        page.wait_for_selector(FULL)
        for tone, overlay, left in looks:
            page.select_option("#tone", tone)
            page.select_option("#left", left)
            page.select_option("#overlay", overlay)
            rest(page)
            slide(page, "#stops", 1.5)
            looked_up = pixels(page, "#picture")
            page.evaluate(
                "const {width: w, height: h} = picture, c = light.gl.canvas; light.shade(light.settings, w, h);"
                "light.paper.drawImage(c, 0, c.height - h, w, h, 0, 0, w, h)"
            )
            off = np.abs(looked_up - pixels(page, "#picture")).max(axis=2)
            if overlay == "stops":  # Where bands meet, rounding decides.
                assert (off > 2.5 / 255).mean() < 0.01
            else:
                assert off.max() < 2.5 / 255, (tone, overlay, left)
            page.evaluate("light.shaded = null, light.draw()")


def test_without_webgl_the_light_is_shown_all_the_same(chromium, serve):
    server, get = serve(count=2), "HTMLCanvasElement.prototype.getContext"
    run = server.viewer.runs[0].run
    script = f"const get = {get}; {get} = function (...how) {{ return how[0] === '2d' ? get.apply(this, how) : null; }}"
    with page_of(chromium, server.url, script=script) as page:
        page.wait_for_selector(FULL)
        assert page.evaluate("light.gl") is None and page.is_disabled("#overlay [value=depth]")
        light = light_of(page, run)
        exposure = light / display_gain(run.response)
        np.testing.assert_allclose(pixels(page, "#picture"), run.response.encode(exposure), atol=2.5 / 255)
        page.select_option("#tone", "none")
        slide(page, "#stops", -2)
        np.testing.assert_allclose(pixels(page, "#picture"), encode_srgb(light * 0.25), atol=2.5 / 255)
        looks = [pixels(page, "#picture")]
        for overlay in ("stops", "clipped"):
            page.select_option("#overlay", overlay)
            rest(page)
            looks.append(pixels(page, "#picture"))
        assert all(np.abs(looks[0] - look).mean() > 0.01 for look in looks[1:])
        page.select_option("#overlay", "none")
        settle(page, lambda: page.select_option("#left", "run1"))


def test_what_is_coarse_while_it_moves_is_whole_soon(chromium, serve):
    with page_of(chromium, serve().url) as page:
        page.wait_for_selector(FULL)
        for coarser in (
            "light.wide = 3",
            "light.settings.overlay = 'depth', light.scale = 0.25",
        ):  # While it moves; then whole.
            coarse = page.evaluate(f"light.drawn = performance.now(), {coarser}, light.draw(), picture.toDataURL()")
            until(page, "!light.coarse")
            whole = page.evaluate("picture.toDataURL()")
            assert whole != coarse
            page.evaluate("light.draw()")
            assert page.evaluate("picture.toDataURL()") == whole


def test_moving_resizing_and_two_at_once(chromium, serve):
    server = serve()
    with page_of(chromium, server.url) as page, page_of(chromium, server.url) as other:
        other.wait_for_selector(FULL)
        before, theirs = None, pixels(other, "#picture")
        page.wait_for_selector(FULL)
        for button in ("left", "right"):
            before = page.evaluate("window.viewer.camera().world_to_camera")
            page.mouse.move(150, 150)
            page.mouse.down(button=button)
            page.mouse.move(190, 170, steps=4)
            page.mouse.up(button=button)
            settle(page, lambda: page.mouse.wheel(0, 120))
            assert page.evaluate("window.viewer.camera().world_to_camera") != before
        settle(page, lambda: page.set_viewport_size({"width": 900, "height": 600}))
        assert pixels(page, "#picture").shape[:2] == (600, 900 - 288)
        page.focus("#stage")
        opening, first = page.evaluate("facts.opening.world_to_camera"), int(page.input_value("#view"))
        views = [view["camera"]["world_to_camera"] for view in page.evaluate("facts.views")]
        away = [np.linalg.norm(np.linalg.inv(view)[:3, 3] - np.linalg.inv(opening)[:3, 3]) for view in views]
        assert away[first] == min(away)  # The page opens at the place of this photo.
        settle(page, lambda: page.keyboard.press("ArrowRight"))
        assert page.input_value("#view") == str(first + 1)
        page.focus("#stage")
        settle(page, lambda: (page.keyboard.down("w"), page.wait_for_timeout(80), page.keyboard.up("w")))
        for _ in range(2):
            page.click("#addView")
        page.fill("#length", "0.2")
        with page.expect_download() as download:
            page.click("#savePath")
        assert '"cameras"' in download.value.path().read_text()
        np.testing.assert_array_equal(pixels(other, "#picture"), theirs)


def test_brackets_and_a_film_are_saved_and_errors_are_shown(chromium, serve):
    pytest.importorskip("av")
    with page_of(chromium, serve().url, width=440, height=260) as page:
        page.wait_for_selector(FULL)
        page.click("[data-save=film]")
        assert page.text_content("#saved") == "add two views or more first"
        page.click("#addView")
        page.focus("#stage")
        settle(page, lambda: page.keyboard.press("ArrowRight"))
        page.click("#addView")
        page.fill("#length", "0.2")
        page.click("#play")
        there = "(a, b) => a.world_to_camera[0].every((x, i) => Math.abs(x - b.world_to_camera[0][i]) < 1e-6)"
        until(page, f"({there})(window.viewer.camera(), state.path[1])")
        rest(page)
        starts = {"brackets": b"PK", "film": b"\0\0\0"}
        for kind, start in starts.items():
            with page.expect_download() as download:
                page.click(f"[data-save={kind}]")
            assert download.value.path().read_bytes().startswith(start)
            page.locator("#saved", has_text="saved by your browser").wait_for()
        page.click("#clearPath")
        assert page.evaluate("state.path.length") == 0
        box = page.locator("#saved").bounding_box()
        assert box["y"] + box["height"] <= 260  # An answer is in sight.


def test_the_dial_of_a_notebook_exposes_in_a_static_page(chromium, tmp_path):
    run = AnalyticRun()
    (tmp_path / "notebook.html").write_text(f'<!DOCTYPE html><meta charset="utf-8"><title>n</title>{run_html(run)}')
    light = run.render(run.cameras[3].camera).hdr.numpy() * run.base_time * display_gain(run.response)
    with page_of(chromium, (tmp_path / "notebook.html").as_uri()) as page:
        frame = page.frame_locator("iframe")
        frame.locator("output", has_text="s").wait_for()
        for stops in (0, -3):
            frame.locator("input").evaluate(
                "(range, value) => { range.value = value; range.dispatchEvent(new Event('input')); }", str(stops)
            )
            whole = encode_srgb(light * 2.0**stops)
            for _ in range(100):  # It may be coarser while it moves.
                if (error := np.abs(pixels(frame, "canvas") - whole).max()) <= 2.5 / 255:
                    break
                page.wait_for_timeout(100)
            assert error <= 2.5 / 255
