from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.images.display import display_gain, encode_srgb, expose
from sehdr_warp.output.report import write
from sehdr_warp.output.report.charts import training_chart
from sehdr_warp.output.report.comparison import Comparison, compare, darker_stops
from sehdr_warp.output.report.write import check_report_folder, comparison_figure, stops_figure, write_report
from sehdr_warp.scene import Scene, View, codes_of

from ..helpers import AnalyticRun

pytestmark = pytest.mark.usefixtures("coarse_figures")
METRICS = [
    {"iteration": 100, "seconds": 1.5, "split": "test", "psnr_ldr": 20.0, "psnr_mu": 18.0},
    {"iteration": 200, "seconds": 3.0, "split": "test", "psnr_ldr": 26.0, "psnr_mu": 25.5},
]


def make(folder, *, truth=True, splits=("train", "test", "test"), metrics=METRICS):
    run = AnalyticRun([(f"v_{i}", split) for i, split in enumerate(splits)])
    run.metrics = lambda: [{"iteration": 1}, *(metrics or ())]
    views = []
    for entry in run.cameras:
        hdr = run.render(entry.camera).hdr.numpy()
        image = run.response.encode(hdr * entry.exposure_time).astype(np.float32)
        known = {"hdr": hdr} if truth else {}
        views.append(View(entry.name, codes_of(image, 16), entry.camera, entry.exposure_time, entry.split, **known))
    return run, Scene("sky", "photos", tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def columns_of_pictures(path):
    """How many pictures stand side by side: runs of columns that are not white from top to bottom, past the margin."""
    pixels = np.asarray(Image.open(path).convert("L"))
    middle = pixels[pixels.shape[0] // 4 : pixels.shape[0] // 3, 60:]
    dark = (middle < 250).mean(axis=0) > 0.5
    return int(np.sum(dark[1:] & ~dark[:-1]) + dark[0])


@pytest.mark.parametrize("truth, columns", [(True, 5), (False, 4)])
def test_pictures_hold_what_they_say(tmp_path, truth, columns):
    run, scene = make(tmp_path, truth=truth)
    files = write_report(run, scene, tmp_path / "report")
    assert [file.name for file in files] == ["report.html", "comparison.png", "stops.png", "training.png"]
    assert columns_of_pictures(files[1]) == columns
    assert sorted(file.name for file in (tmp_path / "report").glob("[!.]*")) == sorted(file.name for file in files)


def test_without_test_views_and_metrics(tmp_path):
    run, scene = make(tmp_path, splits=("train", "train"), metrics=None)
    files = write_report(run, scene, tmp_path / "report", view_count=1)
    assert [file.name for file in files] == ["report.html", "comparison.png", "stops.png"]
    empty = Scene("none", "photos", (), np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    with pytest.raises(SehdrError, match="no views"):
        write_report(run, empty, tmp_path / "empty")


def test_the_chart_has_a_line_for_every_run_and_a_name_for_every_row():
    figure = training_chart({"sky": [METRICS]})
    curves = [[line.get_xydata().tolist() for line in axes.get_lines()] for axes in figure.axes]
    assert curves == [[[[1.5, 20.0], [3.0, 26.0]]], [[[1.5, 18.0], [3.0, 25.5]]]]
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["Photos: 26.0 dB", "HDR, mu-law (gt-max): 25.5 dB"] and not figure.legends
    only = [{"seconds": 1.0, "psnr_ldr": 20.0}, {"iteration": 3}]
    figure = training_chart({"a and 1 more": [METRICS, METRICS], "c": [only]})
    assert [len(axes.get_lines()) for axes in figure.axes] == [3, 2]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a and 1 more", "c"]


def test_stops_show_what_the_photo_lost(tmp_path):
    run, scene = make(tmp_path)
    view = scene.views[1]
    from_photo = run.response.decode(view.image) / view.exposure_time
    confidence = np.full(view.image.shape[:2], 0.25, np.float32)
    comparison = Comparison(view.name, view.image, from_photo, run.render(view.camera).hdr.numpy(), 0.5, 1.0, view.hdr)
    figure = stops_figure(comparison)
    pictures = [axes.get_images()[0].get_array() for axes in figure.axes]
    np.testing.assert_array_equal(pictures[0], view.image)
    photo, hdr, truth = pictures[1:6], pictures[6:11], pictures[11:]
    clipped = comparison.photo == 1
    assert clipped.any()
    assert np.ptp(photo[0][clipped]) < 1e-6
    assert np.ptp(hdr[0][clipped]) > 0.01
    np.testing.assert_array_equal(hdr, truth)
    trusted = stops_figure(replace(comparison, confidence=confidence)).axes[6]
    assert trusted.texts[0].get_text() == "Confidence" and np.all(trusted.get_images()[0].get_array() == 0.25)


def test_the_truth_has_the_scale_of_the_scene(tmp_path, monkeypatch):
    """Photos without exposure times tell radiance up to a factor."""
    run, scene = make(tmp_path)
    scene = replace(scene, views=tuple(replace(view, hdr=3 * view.hdr) for view in scene.views))
    items = []
    monkeypatch.setattr(write, "stops_figure", lambda item: items.append(item) or stops_figure(item))
    monkeypatch.setattr(write, "report_page", lambda *_, **__: "")
    write_report(run, scene, tmp_path / "report", evaluation={"protocol": {"aligned": {"scale": 3.0}}})
    np.testing.assert_allclose(items[0].truth, items[0].hdr, rtol=1e-3)


def test_each_photo_is_re_exposed_from_its_own_exposure(tmp_path):
    """Photos of auto exposure, developed by a response that is not sRGB: 0 EV shows middle grey as the photo does."""
    run, scene = make(tmp_path)
    run.response = SimpleNamespace(name="bright", decode=lambda value: 8 * value**2.2)
    views = [replace(view, exposure_time=view.exposure_time * factor) for view, factor in zip(scene.views, (1, 1, 4))]
    comparisons = [compare(run, view, views) for view in views[1:]]
    figures = [stops_figure(each) for each in comparisons]
    for view, figure in zip(views[1:], figures, strict=True):
        photo, at_zero = (figure.axes[index].get_images()[0].get_array() for index in (0, 3))
        grey = np.abs(photo - 0.46) < 0.1
        assert grey.any() and np.abs(photo - at_zero)[grey].max() < 0.02, view.name
    pictures = [axes.get_images()[0].get_array() for axes in comparison_figure(comparisons, "").axes[1::5]]
    for each, picture in zip(comparisons, pictures, strict=True):
        expected = expose(each.from_photo, darker_stops(comparisons), scale=each.scale)
        np.testing.assert_array_equal(picture, expected)


def test_photos_in_a_sensors_colors_are_shown_as_the_scene_is(tmp_path):
    run, scene = make(tmp_path)
    view, plain = scene.views[0], compare(run, scene.views[0], scene.views)
    run.color_matrix = np.eye(3)[::-1].copy()
    run.base_time = 0.5 / plain.from_photo.max()  # What is white in a channel counts as clipped: see rec709_of().
    compared = compare(run, view, scene.views)
    np.testing.assert_allclose(compared.from_photo, plain.from_photo[..., ::-1], rtol=1e-5, atol=1e-6)
    light = compared.from_photo * view.exposure_time * display_gain(run.response)
    np.testing.assert_allclose(compared.photo, encode_srgb(light), atol=1e-6)


@pytest.mark.parametrize("caption", ["", "Several lines of text. " * 20])
def test_pictures_keep_their_shape(caption):
    picture = np.ones((20, 30, 3), np.float32)
    figure = comparison_figure([Comparison("v", *[picture] * 3, 0.5, 1.0, picture)], caption)
    figure.draw_without_rendering()
    boxes = [axes.get_window_extent() for axes in figure.axes]
    assert figure.axes[1].get_title() == "Photo at 0 EV"  # Nothing is above the photo's white.
    assert len(boxes) == 4 and all(box.width / box.height == pytest.approx(1.5, rel=0.02) for box in boxes)


def test_pictures_that_a_stopped_report_left_are_not_photos(tmp_path):
    for index in range(3):
        Image.new("RGB", (4, 4)).save(tmp_path / f".comparison.{index}.tmp.png")
    check_report_folder(tmp_path)


def test_a_folder_of_photos_is_not_for_a_report(tmp_path):
    run, scene = make(tmp_path)
    photos = tmp_path / "photos"
    photos.mkdir()
    for index in range(3):
        Image.new("RGB", (4, 4)).save(photos / f"IMG_{index}.jpg")
    with pytest.raises(InputError, match=r"holds photos \(IMG_0.jpg ...\); name a folder for the report alone"):
        write_report(run, scene, photos)
    assert len(list(photos.iterdir())) == 3
    check_report_folder(tmp_path / "new")
