"""Exposure times: units, sets that differ in ISO alone, and times that EXIF contradicts."""

import json

import numpy as np
import pytest

from sehdr_warp.scene.images.exif import parse_number
from sehdr_warp.scene.load import parse_dataset
from tests.make_scenes import write_blender, write_colmap

TIME, NUMBER, ISO = 33434, 33437, 34855


def seconds(dataset):
    return [record.seconds for record in dataset.records]


@pytest.mark.parametrize(
    "text, number",
    [
        ("8 ms", 0.008),
        ("8ms", 0.008),
        ("1/125 s", 0.008),
        ("8000 µs", 0.008),
        ("0,5s", 0.5),
        ("8 min", None),
        ("s", None),
    ],
)
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
