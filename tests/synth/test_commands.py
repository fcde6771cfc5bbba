"""`sehdr-warp synth`, as typed."""

import json

import numpy as np
import OpenEXR
import pytest

from sehdr_warp.response import response_by_name
from sehdr_warp.scene import Camera
from sehdr_warp.scene.color.primaries import matrix_to_rec709
from sehdr_warp.synth.expose import RadianceView, expose
from tests import refusals
from tests.make_scenes import arc_poses, load, write_blender, write_reinhard
from tests.refusals import call

ACESCG = 0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767


@pytest.fixture
def truth(tmp_path):
    """A set of six views, radiance over four decades, and 200 points."""
    rng, ramp = np.random.default_rng(3), 10 ** np.linspace(-2, 2, 32)[:, None]
    views = [
        RadianceView(
            f"r_{index}",
            Camera(32, 32, 32.0, 32.0, 16.0, 16.0, pose),
            (ramp * rng.uniform(0.5, 1.5, (32, 32, 3))).astype(np.float32),
            ("train", "test")[index % 2],
        )
        for index, pose in enumerate(arc_poses(6))
    ]
    folder = tmp_path / "truth"
    write_reinhard(folder, views, [0.5], points=(rng.uniform(-1, 1, (200, 3)), rng.uniform(0, 1, (200, 3))))
    return folder


def refused(capfd, *arguments):
    return refusals.refused(capfd, "synth", *arguments)


@pytest.mark.parametrize("place", ["photos", "truth beside photos"])
def test_openexr_pictures_of_any_primaries_are_truth(tmp_path, place, capfd):
    """Light that is stored in ACEScg gives the photos of the same light in Rec.709."""
    matrix = matrix_to_rec709(ACESCG)
    rng, photos = np.random.default_rng(4), {}
    light = [rng.uniform(0.05, 0.8, (30, 40, 3)) for _ in range(6)]
    for name, to_file, places in (("rec709", np.eye(3), None), ("acescg", np.linalg.inv(matrix), ACESCG)):
        folder = tmp_path / name
        write_blender(folder, 6, size=(40, 30))
        if place == "photos":
            set_frames(folder, ".exr")
        for i in range(6):
            write_light(folder / "images" / f"r_{i}.exr", light[i] @ to_file.T, places)
        out = tmp_path / f"{name}_out"
        assert call("synth", folder, "--out", out, "--response", "srgb", "--exposures", "0.5") == 0, capfd.readouterr()
        assert call("eval", folder / "images", "--truth", folder) == 0, capfd.readouterr()
        photos[name] = [view.codes for view in load(out, exposure_index=0, response="srgb").views]
    for first, second in zip(photos["rec709"], photos["acescg"], strict=True):
        assert np.abs(first.astype(int) - second.astype(int)).max() <= 1


def set_frames(folder, suffix):
    values = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(values["frames"]):
        (folder / "images" / f"r_{i}.png").unlink()
        frame["file_path"] = f"images/r_{i}{suffix}"
        frame.pop("exposure_time", None)
    (folder / "transforms.json").write_text(json.dumps(values))


def write_light(path, light, chromaticities):
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    header |= {} if chromaticities is None else {"chromaticities": chromaticities}
    OpenEXR.File(header, {"RGB": light.astype(np.float32)}).write(str(path))


def test_expose_writes_a_set_of_five_exposures(truth, tmp_path, capfd):
    out = tmp_path / "photos"
    assert call("synth", truth, "--out", out, "--response", "srgb") == 0
    assert "6 views" in capfd.readouterr().out
    truths = load(truth)
    for index in range(5):
        scene = load(out, exposure_index=index)
        again = expose(truths, response_by_name("srgb"), scene.views[0].exposure_time)
        for a, b in zip(scene.views, again.views, strict=True):
            assert a.name == b.name and np.abs(a.image - b.image).max() <= 1.001 / 255
            np.testing.assert_allclose(a.hdr, b.hdr, rtol=6e-4)
    assert len(list(out.glob("train/*.png"))) == 15 and len(scene.points) == 200


def test_expose_takes_times_and_noise(truth, tmp_path):
    call("synth", truth, "--out", tmp_path / "clean", "--exposures", "0.5,4")
    call("synth", truth, "--out", tmp_path / "noisy", "--exposures", "0.5,4", "--noise", "2000,5")
    clean, noisy = (load(tmp_path / name, exposure_index=1) for name in ("clean", "noisy"))
    assert clean.views[0].exposure_time == noisy.views[0].exposure_time == 4
    assert 0.5 / 255 < np.abs(clean.views[0].image - noisy.views[0].image).mean() < 0.2


def test_expose_takes_glare_that_lifts_the_dark_and_leaves_the_truth(truth, tmp_path):
    call("synth", truth, "--out", tmp_path / "clean", "--exposures", "0.5")
    call("synth", truth, "--out", tmp_path / "veiled", "--exposures", "0.5", "--glare", "3")
    for clean, veiled in zip(*(load(tmp_path / name).views for name in ("clean", "veiled")), strict=True):
        np.testing.assert_array_equal(clean.hdr, veiled.hdr)
        dark = clean.hdr.max(axis=2) < 0.03
        assert dark.any() and (veiled.image[dark] > clean.image[dark] + 0.1).all()


def test_expose_tells_what_was_repaired_in_a_response_file(truth, tmp_path, capfd):
    path = tmp_path / "camera.csv"
    path.write_text("0 0\n0.5 0.6\n0.5 0.8\n1 1\n")
    assert call("synth", truth, "--out", tmp_path / "photos", "--response", path, "--exposures", "1") == 0
    assert f"{path}: exposures were not increasing; sorted" in capfd.readouterr().err


def test_expose_refuses_in_a_line(truth, tmp_path, capfd):
    out = tmp_path / "photos"
    assert "--exposures" in refused(capfd, truth, "--out", out, "--exposures", "fast")
    assert "not an exposure above 0" in refused(capfd, truth, "--out", out, "--exposures", "0")
    assert "--noise" in refused(capfd, truth, "--out", out, "--noise", "100")
    assert "veiling glare: index of 40 %; give 0 to 20" in refused(capfd, truth, "--out", out, "--glare", "40")
    assert "kodak" in refused(capfd, truth, "--out", out, "--response", "kodak")
    assert "not found" in refused(capfd, tmp_path / "none", "--out", out)
    assert not out.exists()
    assert call("synth", truth, "--out", out, "--exposures", "1") == 0
    assert "exists already" in refused(capfd, truth, "--out", out, "--exposures", "1")
    assert call("synth", truth, "--out", out, "--exposures", "2", "--overwrite") == 0
    assert load(out).views[0].exposure_time == 2
