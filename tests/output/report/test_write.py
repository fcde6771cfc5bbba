import base64
import re
import zlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.images.display import expose
from sehdr_warp.output.report.comparison import Comparison, compare, darker_stops
from sehdr_warp.output.report.write import check_report_folder, comparison_figure, stops_figure, write_report
from sehdr_warp.scene import Scene

from ..helpers import make

pytestmark = pytest.mark.usefixtures("coarse_figures")


def columns_of_pictures(path):
    """Count pictures side by side: runs of columns that are not white from top to bottom, past the margin."""
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
    figure = stops_figure(replace(comparison, confidence=confidence, name="100_7104", exposure_time=1 / 508))
    figure.draw_without_rendering()
    assert figure.get_children()[-1].get_window_extent().x1 < figure.bbox.x1
    trusted = figure.axes[6]
    assert trusted.texts[0].get_text() == "Confidence" and np.all(trusted.get_images()[0].get_array() == 0.25)


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


def test_the_truth_has_the_scale_of_the_scene(tmp_path):
    """Photos without exposure times tell radiance up to a factor."""
    run, scene = make(tmp_path)
    scene = replace(scene, views=tuple(replace(view, hdr=3 * view.hdr) for view in scene.views))
    figures = {"gt-max": {"psnr_mu": None}, "aligned": {"scale": 3.0}}
    evaluation = {"views": [], "ldr": {"psnr": 30.0, "ssim": 0.9}, "protocol": figures, "regions": {}}
    page = write_report(run, scene, tmp_path / "report", evaluation=evaluation)[0].read_text()
    packed = dict(re.findall(r'data-light="([^"]+)">([^<]*)<', page))
    hdr, truth = (np.frombuffer(zlib.decompress(base64.b64decode(packed[name])), "<f2") for name in ("Scene", "Truth"))
    np.testing.assert_allclose(truth, hdr, rtol=2e-3)
