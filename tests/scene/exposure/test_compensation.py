"""Gains of photos and vignetting: fitted to points in view of cameras, and taken out of codes."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera, Scene, View, codes_of, photo_storage
from sehdr_warp.scene.camera import look_at
from sehdr_warp.scene.exposure.compensation import BAND_ROWS, ExposureCompensation
from sehdr_warp.scene.exposure.matched_points import MatchedPoints, initial_gains, lens_groups

SIZE, PHOTOS = 48, 6
SRGB = response_by_name("srgb")
VIGNETTING = (0.25, 0.1)


@pytest.fixture(scope="module")
def gains():
    rng = np.random.default_rng(3)
    values = 2 ** rng.uniform(-1, 1, (PHOTOS, 1)) * (1 + rng.uniform(-0.15, 0.15, (PHOTOS, 3)))
    values[:-1] /= np.exp(np.log(values[:-1]).mean(0))
    return {f"p_{k}": tuple(row) for k, row in enumerate(values.tolist())}


@pytest.fixture(scope="module")
def points():
    """Return points of a wall at z = 4."""
    return np.c_[np.random.default_rng(1).uniform(-1.5, 1.5, (400, 2)), np.full(400, 4.0)]


def everywhere(vignetting, photos=range(PHOTOS)):
    return {f"p_{k}": vignetting for k in photos}


def photographed(gains, vignetting, focal=lambda name: 60.0) -> Scene:
    """A wall of smooth colors, its photos taken by cameras of such gains, vignetting and focal lengths, by name.

    The last photo is held out.
    """
    views = []
    for index in range(PHOTOS):
        place, f = (0.25 * index - 0.6, 0.1 * (index % 3), 0.0), focal(f"p_{index}")
        camera = Camera(SIZE, SIZE, f, f, SIZE / 2, SIZE / 2, look_at(place, (place[0], place[1], 1), (0, -1, 0)))
        row, column = np.mgrid[:SIZE, :SIZE] + 0.5
        rays = np.stack([(column - 24) / f, (row - 24) / f, np.ones_like(row)], -1) @ camera.world_to_camera[:3, :3]
        wall = place[0] + 4 * rays[..., :1], place[1] + 4 * rays[..., 1:2]
        light = 0.12 + 0.05 * np.sin(np.concatenate([wall[0] + wall[1], 2 * wall[0], 1 - wall[1]], 2))
        r = np.hypot(column - 24, row - 24)[..., None] / np.hypot(24, 24)
        name = f"p_{index}"
        a, b = vignetting.get(name, (0, 0))
        light = light * np.array(gains.get(name, (1, 1, 1))) * np.exp(-a * r**2 - b * r**4)
        split = "test" if index == PHOTOS - 1 else "train"
        views.append(View(name, codes_of(SRGB.encode(light), 8), camera, 1.0, split))
    return Scene("wall", "hand-made", tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.float32))


def test_gains_and_falloff_are_found(gains, points):
    scene = photographed(gains, everywhere(VIGNETTING))
    hidden, visible = points.copy(), np.ones((PHOTOS, len(points)), bool)
    hidden[::10, 2] = 2.0  # points that are none
    hidden[1::2, 2], visible[1:, 1::2] = 7.0, False  # behind the wall, and known to be
    matched = MatchedPoints(scene.train_views, scene.test_views, hidden, visible, SRGB)
    fitted = matched.fit()
    for name, gain in gains.items():
        np.testing.assert_allclose(fitted.gains[name], gain, rtol=0.02)
    assert fitted.corner_loss == pytest.approx(1 - np.exp(-sum(VIGNETTING)), abs=0.03)
    assert fitted.stops > 0.3
    rough = initial_gains(scene.train_views, SRGB)
    np.testing.assert_allclose([rough.gains[v.name] for v in scene.train_views], list(gains.values())[:-1], rtol=0.25)
    rough = matched.rough_fit()
    assert (rough.stops, rough.white_balance) == pytest.approx((fitted.stops, fitted.white_balance), rel=0.15)
    assert rough.corner_loss == pytest.approx(fitted.corner_loss, abs=0.1)
    for colors in (False, True):
        before, after = (matched.disagreement(corrected, colors=colors) for corrected in (None, fitted))
        assert after < 0.1 * before
    wrong = replace(fitted, vignetting=everywhere((0.0, 0.8)))
    assert matched.remaining_vignetting(fitted) < 0.15 and matched.remaining_vignetting(wrong) > 0.8


@pytest.mark.parametrize("cause", ["times", "places"])
def test_gains_that_follow_stated_times_or_places_are_separated(cause):
    """A wrong curve makes gains of the times themselves, what is brighter from one side those of places; what a camera
    rounds is beside them."""
    views = [replace(v, exposure_time=2.0 ** (k % 4)) for k, v in enumerate(photographed({}, {}).train_views)]
    stops = [np.log2(v.exposure_time) if cause == "times" else v.camera.position @ [1.5, 3, 0] for v in views]
    shared = 2 ** (0.4 * np.array(stops))
    along = ExposureCompensation({v.name: (gain, gain, gain) for v, gain in zip(views, shared, strict=True)})
    assert along.stops > 0.2 and along.unexplained_stops(views) == pytest.approx(0, abs=1e-9)
    off = np.array([0.1, -0.2, 0.2, -0.2, 0.1])
    columns = np.array([(1, *v.camera.position[:2], np.log2(v.exposure_time)) for v in views])
    off -= columns @ np.linalg.lstsq(columns, off, rcond=None)[0]  # Of no slope over either
    both = ExposureCompensation(
        {v.name: tuple(2**e * np.array(along.gains[v.name])) for v, e in zip(views, off, strict=True)}
    )
    assert both.unexplained_stops(views) == pytest.approx(off.std()) and off.std() > 0.05
    shared = np.array(list(both.explained_part(views).gains.values())) / list(along.gains.values())
    np.testing.assert_allclose(shared, shared[0, 0])


def test_each_lens_has_its_falloff(gains, points):
    dark = everywhere(VIGNETTING, range(0, PHOTOS, 2))
    scene = photographed(gains, dark, lambda name: 60.0 if name in dark else 70.0)
    visible = np.ones((PHOTOS, len(points)), bool)
    matched = MatchedPoints(scene.train_views, scene.test_views, points, visible, SRGB)
    fitted = matched.fit()
    corners = {name: 1 - np.exp(-sum(fitted.vignetting.get(name, (0, 0)))) for name in gains}
    for name, lacking in corners.items():
        assert lacking == pytest.approx(1 - np.exp(-sum(dark.get(name, (0, 0)))), abs=0.03)
    assert matched.rough_fit().corner_loss == pytest.approx(fitted.corner_loss, abs=0.1)
    assert matched.remaining_vignetting(fitted) < 0.15


def test_a_falloff_is_not_extrapolated_from_the_middle_of_photos(gains, points):
    scene = photographed(gains, everywhere(VIGNETTING))
    views, visible = scene.train_views, np.ones((PHOTOS, len(points)), bool)
    matched = MatchedPoints(views, scene.test_views, points, visible, SRGB)
    assert matched.unmeasured_reach() == (0, 0)
    places = [view.camera.project(points) for view in scene.views]
    middle = np.array(
        [np.hypot(place.row - SIZE / 2, place.column - SIZE / 2) < 0.5 * np.hypot(24, 24) for place in places]
    )
    matched = replace(matched, visible=middle)
    count, reach = matched.unmeasured_reach()
    assert count == PHOTOS - 1 and 0.4 < reach < 0.5
    for fitted in (matched.fit(), matched.rough_fit()):
        assert fitted.corner_loss == 0
        for view in views:
            np.testing.assert_allclose(fitted.gains[view.name], gains[view.name], rtol=0.06)


def test_a_lens_is_recognized_by_exif_and_by_the_field_of_view(tmp_path):
    def exif_photo(index, model, focal=35, aperture=2.8):
        exif, path = Image.Exif(), tmp_path / f"{index}.jpg"
        exif[272] = model
        exif.get_ifd(0x8769).update({37386: focal, 33437: aperture})
        Image.new("RGB", (4, 4)).save(path, exif=exif)
        return path

    views = photographed({}, {}).views

    def lenses(sources, focals=(60.0,) * PHOTOS):
        exif_facts = zip(views, sources, focals, strict=True)
        return lens_groups(
            [replace(v, source=s, camera=replace(v.camera, fx=f, fy=f)) for v, s, f in exif_facts]
        ).tolist()

    one, two = exif_photo(0, "One"), exif_photo(1, "Two")
    assert lenses([None] * PHOTOS) == [0] * PHOTOS == lenses([tmp_path / "none.jpg"] * PHOTOS)
    assert lenses([one, exif_photo(99, "One\0 \0")] * 3) == [0] * PHOTOS
    assert lenses([one, two] * 3) == [0, 1] * 3 == lenses([one, exif_photo(2, "One", aperture=8)] * 3)
    assert lenses([one, exif_photo(3, "One", focal=70)] * 3) == [0, 1] * 3
    # Structure from motion finds a focal length a little differently for each photo.
    assert lenses([one] * PHOTOS, (60.0, 61.0, 62.5, 59.0, 60.5, 61.5)) == [0] * PHOTOS
    assert lenses([one] * PHOTOS, (60.0, 70.0) * 3) == [0, 1] * 3
    # Too few of a lens are one with others, and none where those are few too.
    zoomed = [exif_photo(4 + k, "One", focal=35 + k) for k in range(PHOTOS)]
    assert lenses(zoomed) == [0] * PHOTOS and lenses([one] * 4 + [two, None]) == [0, 0, 0, 0, -1, -1]


def test_compensated_photos_hold_the_light_without_gains(gains):
    plain, scene = photographed({}, {}), photographed(gains, everywhere(VIGNETTING))
    compensated = ExposureCompensation(gains, everywhere(VIGNETTING)).normalize_photos(scene, SRGB)
    assert ExposureCompensation(gains, everywhere(VIGNETTING)).normalize_photos(compensated, SRGB) is compensated
    for ours, truth in zip(compensated.views, plain.views, strict=True):
        measurable = (truth.image > 0.1) & (ours.image < 0.95)
        light = SRGB.decode(ours.image) / ours.exposure_time
        np.testing.assert_allclose(light[measurable], SRGB.decode(truth.image)[measurable], rtol=0.04)
        assert ours.exposure_time == pytest.approx(max(gains[ours.name]))


def test_an_exposure_alone_leaves_the_codes(gains):
    scene = photographed({}, {})
    twice = ExposureCompensation({"p_0": (2.0, 2.0, 2.0)}).normalize_photos(scene, SRGB)
    assert twice.views[0].exposure_time == 2.0 and twice.views[0].codes is scene.views[0].codes


def test_white_stays_white_and_black_black(gains):
    scene = photographed({}, {})
    codes = scene.views[0].codes.copy()
    codes[:8], codes[-8:] = 255, 0
    scene = replace(scene, views=(replace(scene.views[0], codes=codes), *scene.views[1:]))
    (first, *_) = ExposureCompensation(gains, everywhere(VIGNETTING)).normalize_photos(scene, SRGB).views
    assert first.codes.dtype == np.uint16 and (first.codes[:8] == 65535).all() and (first.codes[-8:] == 0).all()


@pytest.mark.parametrize("vignetting", [None, VIGNETTING])
def test_photos_are_compensated_row_by_row_as_by_their_light(gains, vignetting):
    tall = np.random.default_rng(5).integers(0, 256, (3 * BAND_ROWS + 5, 20, 3), dtype=np.uint8)
    camera = Camera(20, len(tall), 60.0, 60.0, 10.0, len(tall) / 2, np.eye(4))
    view = View("p_0", tall, camera, 2.0, "train")
    fitted = ExposureCompensation(gains, {} if vignetting is None else {"p_0": vignetting})
    (compensated,) = fitted.normalize_photos(
        Scene("tall", "hand-made", (view,), np.zeros((0, 3)), np.zeros((0, 3))), SRGB
    ).views
    largest = max(gains["p_0"])
    light = SRGB.decode(view.image.astype(np.float64)) / (fitted.light(view) / largest)
    expected = codes_of(SRGB.encode(light), 16)
    expected[tall == 255] = 65535
    assert compensated.exposure_time == 2.0 * largest
    assert np.abs(compensated.codes.astype(int) - expected).max() <= 1


def test_photos_that_do_not_fit_into_memory_are_compensated_into_a_file(gains, monkeypatch, caplog):
    scene = photographed(gains, everywhere(VIGNETTING))
    in_memory = ExposureCompensation(gains, everywhere(VIGNETTING)).normalize_photos(scene, SRGB)
    monkeypatch.setattr(photo_storage, "available_memory", lambda: 0)
    with caplog.at_level("INFO"):
        on_disk = ExposureCompensation(gains, everywhere(VIGNETTING)).normalize_photos(scene, SRGB)
    assert "they are read from a nameless file" in caplog.text
    files = {photo_storage.file_of(view.codes) for view in on_disk.views}
    assert len(files) == 1 and None not in files
    assert all(np.array_equal(a.codes, b.codes) for a, b in zip(on_disk.views, in_memory.views, strict=True))
    # Photos that are left as they are stay in the file where they were.
    again = ExposureCompensation({}).normalize_photos(replace(on_disk, photos_normalized=False), SRGB)
    assert all(a.codes is b.codes for a, b in zip(again.views, on_disk.views, strict=True))
