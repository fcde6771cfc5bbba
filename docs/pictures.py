"""Make the pictures of README and guide from a scene that is photographed by a camera that clips.

python docs/pictures.py [SCENE] [RUN] [VIEW]            minutes on two cores; a RUN that exists is not trained again
python docs/pictures.py --photos FOLDER RUN VIEW        drone.jpg, of github.com/pierotofy/drone_dataset_brighton_beach
"""

import importlib.util
import io
import shutil
import sys
from pathlib import Path
from threading import Thread

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import uniform_filter

import sehdr_warp as sw
from sehdr_warp.output.cameras.paths import interpolate
from sehdr_warp.output.images.display import expose as expose_light
from sehdr_warp.output.images.ldr_files import quantize
from sehdr_warp.output.report.comparison import compare, darker_stops
from sehdr_warp.synth.expose import expose, exposure_ladder

PICTURES = Path(__file__).parent / "images"
WIDTH = 1500
CROPPED, GAP, TITLE = 0.36, 8, 40  # Part of a picture that is enlarged; pixels between pictures and of a title
FONT = ImageFont.load_default(24)
SOFTWARE = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
WINDOW = {"width": 1280, "height": 720}
REST = 3000  # Milliseconds until a page in software WebGL is whole


def main(name: str = "embedded:lamps", folder: str = "runs/hero", view: str = "") -> None:
    """Write hero.jpg and viewer.jpg of one held-out view of an embedded scene."""
    truth, camera = sw.load_scene(name), sw.response_by_name("camera")
    scene = expose(truth, camera, exposure_ladder(truth, camera)[2])
    run = sw.load_run(folder) if Path(folder).exists() else sw.train(scene, folder, {"response.name": "camera"})
    photo_view = next(each for each in scene.test_views if each.name == (view or each.name))
    _save(_beside(run, photo_view, scene), "hero.jpg")
    if shutil.which("chromium") and importlib.util.find_spec("playwright"):
        _save(_browsed(run, photo_view, scene), "viewer.jpg")
    else:
        print("viewer.jpg stays as it was: it needs Chromium and playwright (pip install 'sehdr-warp[test]')")


def photographed(photos: str, folder: str, view: str) -> None:
    """Write drone.jpg: a photo, the scene there, the same 1.5 stops darker, the scene half-way to the next photo."""
    if not Path(folder).exists():
        sw.train(sw.load_scene(photos, max_size=360), folder)
    run = sw.load_run(folder)
    scene = run.normalize_photos(sw.load_scene(photos, max_size=360, response=run.response))
    photo_view = next(each for each in scene.views if each.name == view)
    others = (each.camera for each in scene.views if each is not photo_view)
    near = min(others, key=lambda camera: float(np.linalg.norm(camera.position - photo_view.camera.position)))

    def rendered(camera: sw.Camera, stops: float = 0.0) -> np.ndarray:
        return run.render_ldr(camera, photo_view.exposure_time * 2.0**stops).cpu().numpy()

    between = interpolate([photo_view.camera, near], 3)[1]
    rows = [[photo_view.image, rendered(photo_view.camera)], [rendered(photo_view.camera, -1.5), rendered(between)]]
    gap = np.ones((photo_view.camera.height, 6, 3))
    lines = [np.concatenate([left, gap, right], axis=1) for left, right in rows]
    picture = np.concatenate([lines[0], np.ones((6, lines[0].shape[1], 3)), lines[1]])
    _save(Image.fromarray(quantize(picture)), "drone.jpg")


def _beside(run: sw.Run, photo_view: sw.View, scene: sw.Scene) -> Image.Image:
    """The photo, and photo, scene and truth some stops darker; below each the part that differs most, enlarged."""
    comparison = compare(run, photo_view, scene.views)
    assert comparison.truth is not None
    darker, lights = darker_stops([comparison]), (comparison.from_photo, comparison.hdr, comparison.truth)
    dark = [expose_light(light, darker, scale=comparison.scale) for light in lights]
    height, width = dark[0].shape[:2]
    side = round(CROPPED * min(height, width))
    gain = uniform_filter(np.abs(dark[1] - dark[0]).mean(2), side, mode="constant")
    row, column = np.unravel_index(int(gain.argmax()), gain.shape)
    top, left = (int(np.clip(at - side // 2, 0, most - side)) for at, most in ((row, height), (column, width)))
    titles = ["Photo", *(f"{name} at {darker} EV" for name in ("The photo", "The HDR scene", "The truth"))]
    columns, cell = [], (WIDTH - 3 * GAP) // 4
    for title, picture in zip(titles, [comparison.photo, *dark], strict=True):
        whole = Image.fromarray(quantize(picture))
        part = whole.crop((left, top, left + side, top + side)).resize((cell, cell), Image.Resampling.BICUBIC)
        whole = whole.resize((cell, round(cell * height / width)), Image.Resampling.LANCZOS)
        frame = [round(value * cell / width) for value in (left, top, left + side, top + side)]
        ImageDraw.Draw(whole).rectangle(frame, outline="white", width=2)
        canvas = Image.new("RGB", (cell, TITLE + whole.height + GAP + cell), "white")
        place = (cell / 2, TITLE / 2)
        ImageDraw.Draw(canvas).text(place, title, "black", FONT, anchor="mm")
        canvas.paste(whole, (0, TITLE))
        canvas.paste(part, (0, TITLE + whole.height + GAP))
        columns.append(canvas)
    picture = Image.new("RGB", (4 * cell + 3 * GAP, columns[0].height), "white")
    for index, canvas in enumerate(columns):
        picture.paste(canvas, (index * (cell + GAP), 0))
    return picture


def _browsed(run: sw.Run, photo_view: sw.View, scene: sw.Scene) -> Image.Image:
    """The page of `view`, two and a half stops down beside the photo, with the pointer on the brightest light."""
    from playwright.sync_api import sync_playwright

    from sehdr_warp.viewer.server import Server, Viewer
    from sehdr_warp.viewer.viewer_scene import ViewerScene

    photos = {view.name: view for view in scene.views}
    viewer = Viewer([ViewerScene(run, run.scene_name)], lambda _: photos)
    with Server(viewer, port=18080) as server, sync_playwright() as driver:
        Thread(target=server.serve_forever, daemon=True).start()
        chromium = driver.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE)
        page = chromium.new_page(viewport=WINDOW)
        page.goto(server.url)
        page.select_option("#view", label=f"{photo_view.name} ({photo_view.split})")
        page.select_option("#left", "photo")
        page.locator("#stops").evaluate("range => { range.value = -2.5; range.dispatchEvent(new Event('input')); }")
        page.wait_for_timeout(REST)
        page.wait_for_selector("#stage[data-frame=full]")
        box = page.locator("#picture").bounding_box()
        assert box is not None
        light = run.render(photo_view.camera).hdr.sum(2)
        row, column = divmod(int(light[:, light.shape[1] // 2 :].argmax()), light.shape[1] // 2)
        scale = box["height"] / light.shape[0]
        # The photo has the left half.
        page.mouse.move(box["x"] + box["width"] / 2 + (column + 0.5) * scale, box["y"] + (row + 0.5) * scale)
        page.wait_for_timeout(REST)
        picture = Image.open(io.BytesIO(page.screenshot()))
        chromium.close()
        server.shutdown()
    return picture


def _save(picture: Image.Image, name: str) -> None:
    picture = picture.convert("RGB")
    picture.thumbnail((WIDTH, WIDTH))
    picture.save(PICTURES / name, quality=88, optimize=True)


if __name__ == "__main__":
    photographed(*sys.argv[2:]) if sys.argv[1:2] == ["--photos"] else main(*sys.argv[1:])
