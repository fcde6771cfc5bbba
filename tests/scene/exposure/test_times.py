"""Exposure times: units, sets that differ in ISO alone, and times that EXIF contradicts."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene.dataparser import PlacedPhoto
from sehdr_warp.scene.exposure.times import shutter
from sehdr_warp.scene.images.exif import parse_number
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.load import load_scene, parse_dataset
from tests.make_scenes import arc_poses, edited_json, load, pattern, write_blender, write_colmap

TIME, NUMBER, ISO, APEX = 33434, 33437, 34855, 37377


def seconds(dataset):
    return [record.seconds for record in dataset.records]


@pytest.mark.parametrize(
    "text, number",
    [
        ("8 ms", 0.008), ("8ms", 0.008), ("1/125 s", 0.008), ("8000 µs", 0.008), ("0,5s", 0.5),
        ("8 min", None), ("s", None),
    ],
)  # fmt: skip
def test_numbers_with_units(text, number):
    assert parse_number(text) == (None if number is None else pytest.approx(number))


def test_photos_that_differ_in_iso_and_f_number_alone(tmp_path):
    settings = [(100, 4), (200, 4), (400, 4), (100, 8), (100, 2)]
    write_colmap(tmp_path, 5, name="{:03d}.jpg", exif={i: {ISO: v, NUMBER: n} for i, (v, n) in enumerate(settings)})
    dataset = parse_dataset(tmp_path)
    np.testing.assert_allclose(seconds(dataset), [1, 2, 4, 0.25, 4])
    assert dataset.times_known and "ISO differs (100 to 400); exposure times are relative to 100" in dataset.notes
    assert any(
        note.startswith("photos state no exposure time, and count as 1 s at the first") for note in dataset.notes
    )


@pytest.mark.parametrize("exif", [{i: {ISO: 100} for i in range(5)}, {i: {ISO: 100 + i} for i in range(4)}])
def test_iso_that_is_the_same_or_not_stated_for_all_tells_nothing(tmp_path, exif):
    write_colmap(tmp_path, 5, name="{:03d}.jpg", exif=exif)
    dataset = parse_dataset(tmp_path)
    assert not dataset.times_known and seconds(dataset) == [1.0] * 5


def test_photos_without_the_iso_that_most_state_count_as_the_median_or_by_light(tmp_path):
    exif = {i: {TIME: 0.01, ISO: 100 * (1 + i % 2), NUMBER: 4} for i in range(6)}
    del exif[5][ISO], exif[4][NUMBER]  # All f-numbers are the same, so one that is missing tells nothing.
    write_colmap(tmp_path, 6, name="{:03d}.jpg", exif=exif)
    dataset = parse_dataset(tmp_path)
    assert [record.time_known for record in dataset.records] == [True] * 5 + [False]
    np.testing.assert_allclose(seconds(dataset)[:5], [0.01, 0.02, 0.01, 0.02, 0.01])
    note = "ISO differs (100 to 200); exposure times are relative to 100; 1 photo does not state it"
    assert note in dataset.notes and not any("f-number" in note for note in dataset.notes)
    alike = {i: {TIME: 0.01, ISO: 125 if i == 1 else 100} for i in range(6)}
    del alike[5][ISO]
    write_colmap(tmp_path / "alike", 6, name="{:03d}.jpg", exif=alike)
    dataset = parse_dataset(tmp_path / "alike")
    np.testing.assert_allclose(seconds(dataset), [0.01, 0.0125, 0.01, 0.01, 0.01, 0.01])
    assert any(note.endswith("1 photo does not state it, for which 100 counts") for note in dataset.notes)
    for i in (3, 4):
        del exif[i][ISO]
    write_colmap(tmp_path / "few", 6, name="{:03d}.jpg", exif=exif)
    dataset = parse_dataset(tmp_path / "few")
    assert seconds(dataset) == [0.01] * 6 and all(record.time_known for record in dataset.records)
    assert "ISO is not stated by 3 of 6 photos and was not counted" in dataset.notes


@pytest.mark.parametrize("factor, unit", [(1e3, "milliseconds"), (1e6, "microseconds")])
def test_times_whose_unit_exif_shows(tmp_path, factor, unit):
    write_colmap(tmp_path, 5, name="{:03d}.jpg", exif={i: {TIME: 0.01 * (i + 1), ISO: 100} for i in range(5)})
    stated = {f"{i:03d}.jpg": factor * 0.01 * (i + 1) for i in range(3)}
    (tmp_path / "exposures.json").write_text(json.dumps(stated))
    dataset = parse_dataset(tmp_path)
    np.testing.assert_allclose(seconds(dataset), [0.01, 0.02, 0.03, 0.04, 0.05])
    assert f"stated exposure times are {factor:g} times those of EXIF, and count as {unit}" in dataset.notes


def test_times_that_exif_contradicts_are_named_and_count(tmp_path):
    write_colmap(tmp_path, 5, name="{:03d}.jpg", exif={i: {TIME: 0.01, ISO: 100 * 2**i} for i in range(5)})
    (tmp_path / "exposures.json").write_text(json.dumps({f"{i:03d}.jpg": 0.01 for i in range(5)}))
    dataset = parse_dataset(tmp_path)
    assert seconds(dataset) == [0.01] * 5
    note = "stated exposure times differ by up to 2.0 stops from EXIF, which counts ISO and f-number"
    assert f"{note}; the stated ones count" in dataset.notes
    (tmp_path / "exposures.json").write_text(json.dumps({f"{i:03d}.jpg": 0.01 * 2**i for i in range(5)}))
    assert not any("EXIF" in note for note in parse_dataset(tmp_path).notes)


@pytest.mark.parametrize("fields", [{"exposure_time_ms": 8}, {"exposure_time": "8 ms"}, {"exposure_time_us": "8e3"}])
def test_units_of_transforms(tmp_path, fields):
    write_blender(tmp_path, 3, **fields)
    np.testing.assert_allclose(seconds(parse_dataset(tmp_path)), [0.008] * 3)


def test_exif_times_count_sensitivity_and_aperture(tmp_path):
    settings = [(0.01, 100, 4), (0.02, 100, 4), (0.01, 200, 4), (0.01, 100, 8), (0.005, 400, 4), (1, 100, 4)]
    exif = {i: {TIME: t, ISO: iso, NUMBER: n} for i, (t, iso, n) in enumerate(settings)}
    write_colmap(tmp_path, name="{:03d}.jpg", exif=exif)
    scene = load(tmp_path)
    light = [t * iso / 100 * (4 / n) ** 2 for t, iso, n in settings]
    np.testing.assert_allclose([view.exposure_time for view in scene.views], light, rtol=1e-5)
    assert scene.exposure_times_known
    text = " ".join(scene.notes)
    assert "ISO differs (100 to 400)" in text and "exposures differ: 1/400 to 1 s" in text


def test_exposures_of_photos_that_are_left_out_are_not_named(tmp_path, monkeypatch):
    exif = {i: {TIME: 0.01, ISO: 100} for i in range(5)} | {5: {TIME: 1.0, ISO: 400}}
    write_colmap(tmp_path / "model", name="{:03d}.jpg", exif=exif)
    placed = load(tmp_path / "model")
    assert "exposures differ: 1/100 to 4 s" in " ".join(placed.notes)
    photos = shutil.copytree(tmp_path / "model" / "images", tmp_path / "bare")

    def place_all_but_the_last(dataset, _):
        camera = placed.views[0].camera
        lens = Lens("PINHOLE", camera.width, camera.height, tuple(camera.intrinsics), photos)
        records = (replace(r, lens=lens, world_to_camera=np.eye(4)) for r in dataset.records if r.view != "005")
        return replace(dataset, records=tuple(records)), ["005.jpg"]

    monkeypatch.setattr("sehdr_warp.scene.load.place_photos", place_all_but_the_last)
    notes = " ".join(load(photos).notes)
    assert "exposures differ" not in notes and "ISO" not in notes
    damaged = tmp_path / "model" / "images" / "005.jpg"
    damaged.write_bytes(damaged.read_bytes()[:-600])
    notes = " ".join(load(tmp_path / "model").notes)
    assert "1 of 6 photos cannot be used" in notes and "exposures differ" not in notes


@pytest.mark.parametrize(
    "seconds, text",
    [(1 / 640, "1/640 s"), (0.000634115, "1/1577 s"), (0.125, "1/8 s"), (0.28, "0.28 s"), (0.4, "0.4 s"), (8, "8 s")],
)
def test_times_read_as_photographers_write_them(seconds, text):
    assert shutter(seconds) == text


def test_one_photo_without_time_does_not_stop_a_set_and_a_list_helps(tmp_path):
    write_colmap(tmp_path, name="{:03d}.jpg", exif={i: {TIME: 0.01} for i in range(5)})
    assert any(note.startswith("005 does not state its exposure: ") for note in load(tmp_path).notes)
    (tmp_path / "exposures.json").write_text(json.dumps({"005.jpg": 0.02}))
    assert [view.exposure_time for view in load(tmp_path).views] == [0.01] * 5 + [0.02]
    (tmp_path / "exposures.json").write_text(json.dumps({f"{i:03d}.jpg": 2.0 for i in range(6)}))
    assert {view.exposure_time for view in load(tmp_path).views} == {2.0}
    (tmp_path / "exposures.json").write_text(json.dumps({f"{i:03d}.jpg": "1/125" for i in range(6)}))
    assert {view.exposure_time for view in load(tmp_path).views} == {0.008}
    for wrong, words in ((0, 0), (-1, -1), ("1/0", "'1/0'"), ("/2", "'/2'"), ("soon", "'soon'"), (True, "true"),
                         (None, "null"), ([1], "a list of 1")):  # fmt: skip
        (tmp_path / "exposures.json").write_text(json.dumps([{"file": "000.jpg", "exposure_time": wrong}]))
        with pytest.raises(InputError, match=rf"time of .000.jpg. is {words};"):
            load(tmp_path)
    for wrong in ("", "{", "3", "[" * 100_000, '{"000.jpg": NaN}', '{"000.jpg": 1e999}'):
        (tmp_path / "exposures.json").write_text(wrong)
        with pytest.raises(InputError, match=r"exposures\.json|exposure time"):
            load(tmp_path)


@pytest.mark.parametrize(
    "table, words",
    [
        ("[1, 2]", "is not a table of exposure times (entry 0 is 1, not an object)"),
        ('"x"', "is not a table of exposure times (it is 'x', not an object)"),
        ("null", "is not a table of exposure times (it is null, not an object)"),
        ('[{"file": "000.jpg"}]', "is not a table of exposure times (exposure_time is missing)"),
        ('[{"file": [], "exposure_time": 1}]', "(file is a list of 0, not a text)"),
        ('{"000.jpg": 1, "000.jpg": 2}', "(the key '000.jpg' stands twice)"),
        ('[{"file": "0", "exposure_time": 1}, {"file": "0", "exposure_time": 2}]', "(the key '0' stands twice)"),
    ],
)
def test_a_table_that_is_none_is_named_with_what_is_wrong(tmp_path, table, words):
    write_colmap(tmp_path, name="{:03d}.jpg")
    (tmp_path / "exposures.json").write_text(table)
    with pytest.raises(InputError, match=re.escape(words)):
        load(tmp_path)


def test_listed_times_of_no_photo_are_named(tmp_path):
    write_colmap(tmp_path, name="{:03d}.jpg")
    times, table = {f"{i:03d}.jpg": 0.01 for i in range(6)}, tmp_path / "exposures.json"
    table.write_text(json.dumps(times))
    assert not [note for note in load(tmp_path).notes if "exposures.json" in note]
    table.write_text(json.dumps(times | {"000.JPG.bak": 0.01}))
    assert "exposures.json: 1 of its 7 names belong to no photo: 000.JPG.bak" in load(tmp_path).notes
    table.write_text(json.dumps({name.replace("5.jpg", "5x.jpg"): time for name, time in times.items()}))
    notes = load(tmp_path).notes
    assert "exposures.json: 1 of its 6 names belong to no photo: 005x.jpg" in notes
    assert any(note.startswith("005 does not state its exposure: ") for note in notes)
    table.write_text(json.dumps({f"shot{i}.jpg": 0.01 for i in range(6)}))
    assert [note for note in load(tmp_path).notes if "6 of its 6 names" in note and "shot2.jpg ..." in note]


@pytest.mark.parametrize("name", ["exposures.csv", "Exposures.json", "exposure_times.txt"])
def test_lists_of_times_that_are_not_read_are_named(tmp_path, name):
    write_blender(tmp_path)
    (tmp_path / name).write_text("{}")
    note = f'{name} is not read: write exposures.json, {{"file name": seconds, ...}}'
    assert note in load(tmp_path).notes


def test_one_frame_with_an_impossible_time_stops_no_set(tmp_path):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            frame["exposure_time"] = 0.5 if i else -1
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6 and scene.views[1].exposure_time == 0.5
    assert "1 of 6 frames state no usable exposure time: exposure time of './images/r_0' is -1" in scene.notes
    for frame in values["frames"]:
        frame["exposure_time"] = -1
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    with pytest.raises(InputError, match="exposure time of './images/r_0' is -1; state seconds above zero"):
        load(tmp_path)


@pytest.mark.parametrize(
    "name",
    ["{}.JPG", "{}.CR2", "images/{}", "C:\\scan\\images\\{}.jpg", "/home/me/scan/images/{}.jpg", "./IMAGES/{}.jpg"],
)
def test_listed_times_under_other_spellings(tmp_path, name):
    """Another case, the suffix of another kind of photo, or a path of the machine that wrote the list."""
    write_colmap(tmp_path, name="img_{}.jpg")
    times = {name.format(f"img_{i}"): 0.01 * 2**i for i in range(6)}
    (tmp_path / "exposures.json").write_text(json.dumps(times))
    scene = load(tmp_path, holdout=0)
    assert [view.exposure_time for view in scene.views] == pytest.approx(list(times.values()))
    assert not [note for note in scene.notes if "exposures.json" in note]


def test_a_run_keeps_the_times_that_it_estimated_if_its_photos_are_renamed(tmp_path):
    """Disks of cameras change the case of names."""
    lens, cameras = Lens("SIMPLE_PINHOLE", 32, 24, (30.0, 16.0, 12.0), tmp_path), []
    for i, pose in enumerate(arc_poses(5)):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: 0.01} if i else {})
        Image.fromarray(pattern(32, 24, i)).save(tmp_path / f"img_{i}.jpg", exif=exif)
        cameras.append(PlacedPhoto(f"IMG_{i}.JPG", lens, pose, "train", 0.01 if i else 0.04))
    scene = load_scene(tmp_path, response="srgb", cameras=cameras)
    assert [view.exposure_time for view in scene.views] == pytest.approx([0.04] + [0.01] * 4)
