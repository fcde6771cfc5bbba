"""A reading of a meter sets the unit of light, and files state it."""

import json
import logging
import math
import re

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.images.display import exposure_for_white
from sehdr_warp.output.images.tonemap import LUMINANCE
from sehdr_warp.output.lighting.environment_map import write_environment_map
from sehdr_warp.output.lighting.lights import lights_table, write_lights
from sehdr_warp.output.lighting.unit import EFFICACY, meter, read_light_unit
from sehdr_warp.output.render_views import render_views
from sehdr_warp.runs.values import LIGHT_UNIT_FILE
from sehdr_warp.scene.images.hdr_files import read_exr_channels, read_hdr

from ..helpers import LIGHTS, AnalyticRun


@pytest.fixture
def run(tmp_path):
    """A sky with a run folder."""
    sky = AnalyticRun()
    sky.path = tmp_path / "run"
    sky.path.mkdir()
    sky.render_clipped = lambda camera: None
    return sky


def light_at(run, name, x, y):
    camera = next(entry.camera for entry in run.cameras if entry.name == name)
    hdr = np.asarray(run.render(camera).hdr)
    return float(hdr[y - 2 : y + 3, x - 2 : x + 3].mean((0, 1)) @ LUMINANCE)


def test_a_luminance_and_a_grey_card_give_the_same_unit(run):
    unit = meter(run, "r_1", (12, 10), luminance=100.0)
    assert unit.luminance == pytest.approx(100 / light_at(run, "r_1", 12, 10), rel=1e-5)
    card = meter(run, "r_1", (12, 10), illuminance=100 * math.pi / 0.18)
    assert card.luminance == pytest.approx(unit.luminance) and "reflectance of 0.18" in str(card)
    assert read_light_unit(run) == card  # The last reading counts.


def test_pictures_and_maps_state_the_unit_and_keep_their_values(run, tmp_path):
    files = render_views(run, tmp_path / "before", cameras="test", evs="-2,2")
    unit = meter(run, "r_0", (16, 12), luminance=250.0).luminance
    for before in files:
        if before.suffix != ".exr":
            continue
        assert "whiteLuminance" not in read_exr_channels(before)[1]
    files = render_views(run, tmp_path / "after", cameras="test", evs="-2,2")
    exr = [path for path in files if path.suffix == ".exr"]
    assert len(exr) == 6
    for path in exr:
        channels, header = read_exr_channels(path)
        assert header["whiteLuminance"] * header["expTime"] == pytest.approx(unit, rel=1e-5)
        assert "cd/m^2" in header["sehdr:units"]
        relative, _ = read_exr_channels(tmp_path / "before" / path.relative_to(tmp_path / "after"))
        assert np.array_equal(channels["G"], relative["G"])


def test_radiance_files_hold_watts(lit, tmp_path):
    plain = write_environment_map(lit, tmp_path / "plain.hdr", size=32)
    unit = meter(lit, "0", (16, 12), luminance=250.0).luminance
    path = write_environment_map(lit, tmp_path / "map.hdr", size=32)
    assert plain.read_bytes().count(b"EXPOSURE") == 0
    # Readers divide values by EXPOSURE for W / (sr m^2), and programs of Radiance take 179 lm for each W.
    assert EFFICACY * read_hdr(path) == pytest.approx(unit * read_hdr(plain), rel=1e-5)
    exr = write_environment_map(lit, tmp_path / "map.exr", size=32)
    assert read_exr_channels(exr)[1]["whiteLuminance"] == pytest.approx(unit, rel=1e-6)


def test_lights_are_in_candelas(lit, tmp_path):
    unit = meter(lit, "0", (16, 12), luminance=250.0).luminance
    write_lights(lit, tmp_path / "lights.json", axes="scene")
    lights_file = json.loads((tmp_path / "lights.json").read_text())
    assert lights_file["units"] == "cd/m^2, linear Rec.709"
    assert lights_file["lights"][0]["radiance"] == pytest.approx([8 * unit, 4 * unit, 2 * unit])
    assert "cd/m^2" in lights_table(LIGHTS, unit) and "radiance" in lights_table(LIGHTS)
    write_lights(lit, tmp_path / "lights.usda", axes="scene")
    assert f"float inputs:intensity = {unit!r}\n        asset inputs:texture" in (tmp_path / "lights.usda").read_text()


def test_lights_are_in_the_units_of_plates_with_a_reference_white(lit, tmp_path):
    meter(lit, "0", (16, 12), luminance=250.0)
    factor = exposure_for_white(lit, 2.0)
    write_lights(lit, tmp_path / "lights.json", axes="scene", reference_white=2.0)
    lights_file = json.loads((tmp_path / "lights.json").read_text())
    assert lights_file["units"] == "white is 2, linear Rec.709"
    assert lights_file["lights"][0]["radiance"] == pytest.approx([8 * factor, 4 * factor, 2 * factor])
    write_lights(lit, tmp_path / "lights.usda", axes="scene", reference_white=2.0)
    assert (
        f"float inputs:intensity = {factor!r}\n        asset inputs:texture" in (tmp_path / "lights.usda").read_text()
    )
    with pytest.raises(SehdrError, match="white 0.0 is not between"):
        write_lights(lit, tmp_path / "none.json", reference_white=0.0)


def test_a_clipped_place_is_named(run, caplog):
    run.render_clipped = lambda camera: torch.ones(camera.height, camera.width)
    with caplog.at_level(logging.WARNING):
        meter(run, "r_0", (16, 12), luminance=250.0)
    assert "photos clip at 16,12 of r_0" in caplog.text


@pytest.mark.parametrize(
    "options, problem",
    [
        ({"view": "r_9", "luminance": 5.0}, r"'r_9' is not one of the scene's \(r_0, r_1.*did you mean r_"),
        ({"pixel": (400, 2), "luminance": 5.0}, "outside of view r_0, which has 32 x 24 pixels"),
        ({"luminance": 5.0, "illuminance": 5.0}, "one of luminance"),
        ({}, "one of luminance"),
        ({"luminance": 5.0, "reflectance": 0.5}, "a reflectance is that of a surface whose illuminance"),
        ({"luminance": -5.0}, "not a positive number"),
        ({"luminance": math.nan}, "not a positive number"),
        ({"illuminance": 5.0, "reflectance": 18.0}, "reflectance 18"),
        ({"luminance": 1e300}, "is not between"),
        ({"luminance": "5"}, "luminance is '5', expected a number"),
        ({"view": 3, "luminance": 5.0}, "view '3' is not one of the scene's"),
        ({"pixel": (16,), "luminance": 5.0}, r"pixel \(16,\) is not two numbers"),
        ({"pixel": 16, "luminance": 5.0}, "pixel 16 is not two numbers"),
        ({"area": 0, "luminance": 5.0}, "area 0 is not a number of pixels"),
        ({"area": 1.5, "luminance": 5.0}, "area 1.5 is not a number of pixels"),
    ],
)
def test_readings_that_cannot_be_are_refused(run, options, problem):
    with pytest.raises((SehdrError, TypeError), match=problem):
        meter(run, **{"view": "r_0", "pixel": (16, 12)} | options)
    assert not (run.path / LIGHT_UNIT_FILE).exists()


HUGE = f'{{"luminance": 1, "view": "a", "pixel": [1{"0" * 400}, 2], "reading": "x"}}'


@pytest.mark.parametrize(
    "text, words",
    [
        ("{}", "cannot be used (pixel is missing)"),
        (
            '{"luminance": 0, "view": "a", "pixel": [1, 2], "reading": "x"}',
            "cannot be used (luminance 0.0 is not between",
        ),
        ('{"luminance": null, "view": "a", "pixel": [1, 2], "reading": "x"}', "(luminance is null, not a number)"),
        ('{"luminance": 1, "view": "a", "pixel": [1], "reading": "x"}', "(pixel holds 1 numbers, not 2 numbers)"),
        ('{"luminance": 1, "view": [], "pixel": [1, 2], "reading": "x"}', "(view is a list of 0, not a text)"),
        (HUGE, "pixel is a list of 2, not 2 numbers"),
        ("[1]", "holds a list of 1, not an object"),
        ("{", "is not valid JSON"),
    ],
)
def test_a_damaged_file_is_named(run, text, words):
    (run.path / LIGHT_UNIT_FILE).write_text(text)
    with pytest.raises(InputError, match=f"{LIGHT_UNIT_FILE}: .*{re.escape(words)}"):
        read_light_unit(run)
