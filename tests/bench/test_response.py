"""Finding responses, measured: the error, the truth from a stack, and the whole command."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.bench.exposure_stack import read_stack, stack_curve
from sehdr_warp.bench.response import CODES, _decoded_psnr, bench_response, curve_stops, response_error
from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name

TIMES = (0.02, 0.08, 0.32, 1.28)


def write_stack(folder, response="rec709", times=TIMES, exif=True):
    """Photos of random light over 10 stops, through a known response."""
    folder.mkdir()
    light = np.exp2(np.random.default_rng(0).uniform(-7, 3, (96, 128, 3)))
    curve, entries = response_by_name(response), []
    for index, time in enumerate(times):
        photo = Image.fromarray(np.round(curve.encode(light * time) * 255).astype(np.uint8))
        tags = Image.Exif()
        if exif:
            tags.get_ifd(0x8769)[0x829D] = 8.0
        photo.save(folder / f"{index}.jpg", quality=100, subsampling=0, exif=tags)
        entries.append({"file": f"{index}.jpg", "exposure_time": time})
    (folder / "exposures.json").write_text(json.dumps(entries))
    return folder


def test_error_ignores_scale_and_nothing_else():
    srgb = response_by_name("srgb")
    assert response_error(srgb, srgb) == 0
    assert response_error(srgb, curve_stops(srgb) + 3) == pytest.approx(0, abs=1e-9)
    gamma = response_by_name("gamma-2.2")
    stops = np.log2(((CODES / 255) ** 2.2) / srgb.decode(CODES / 255.0))
    assert response_error(gamma, srgb) == pytest.approx(np.std(stops), rel=1e-3)


@pytest.mark.parametrize("name", ["rec709", "srgb", "camera"])
def test_stack_gives_the_true_curve(tmp_path, name):
    _, images, times = read_stack(write_stack(tmp_path / "stack", name))
    curve = stack_curve(images, times)
    assert response_error(response_by_name(name), curve[CODES]) < 0.06 and curve[128] == pytest.approx(0, abs=1e-9)


def test_stacks_that_cannot_be_used(tmp_path):
    folder = write_stack(tmp_path / "stack")
    entries = json.loads((folder / "exposures.json").read_text())
    for damage, message in (
        ("{", "no list"),
        (json.dumps([{"file": "0.jpg"}]), "no list"),
        (json.dumps([entries[0] | {"exposure_time": 1}, entries[1] | {"exposure_time": 1}]), "two different"),
        (json.dumps([entries[0], entries[1] | {"exposure_time": -1}]), "positive"),
    ):
        (folder / "exposures.json").write_text(damage)
        with pytest.raises(InputError, match=message):
            read_stack(folder)
    with pytest.raises(InputError, match="well exposed"):
        stack_curve([np.zeros((32, 32, 3)), np.ones((32, 32, 3))], np.array([1.0, 2.0]))


def test_report_over_a_stack_and_the_embedded_scene(tmp_path):
    stack = write_stack(tmp_path / "stack")
    report = bench_response(
        [str(stack), "embedded"], ["hdr-nerf"], exposures=2, max_size=80, progress=lambda line: None
    )
    rows = {(row["stage"], row["method"]): row for row in report["rows"]}
    assert rows["stack", "always srgb"]["mean_error"] == pytest.approx(
        response_error(response_by_name("srgb"), response_by_name("rec709")), abs=0.05
    )
    # EXIF says that a camera made them, and there is no edge to say otherwise.
    assert rows["stack", "posterior"]["chosen"] == "camera 4"
    assert ("stack", "posterior without prior") in rows and rows["stack", "posterior without edges"]["trials"] == 4
    assert rows["scene", "posterior without span"]["trials"] == 2
    scene = rows["scenes", "posterior"]
    assert scene["trials"] == 2 and scene["mean_error"] <= scene["worst_error"]
    assert scene["aligned_db"] <= scene["aligned_known_db"] + 0.1
    assert len(report["trials"]) == (len(TIMES) + 2) * 11


def test_clipped_light_does_not_scale_what_is_decoded():
    """The true curve needs no factor, though most of the photo clips."""
    truth = response_by_name("camera")
    hdr = np.exp(np.random.default_rng(0).normal(1.5, 1.5, (60, 60, 3))).astype(np.float32)
    image = (np.round(truth.encode(hdr) * 255) / 255).astype(np.float32)
    assert 0.6 < (image == 1).mean() < 0.9
    plain, aligned = _decoded_psnr([SimpleNamespace(hdr=hdr, image=image)], truth, 1.0)
    assert aligned == pytest.approx(plain, abs=0.1)
