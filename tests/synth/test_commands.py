"""`sehdr-warp synth`, as typed."""

import numpy as np

from sehdr_warp.response import response_by_name
from sehdr_warp.scene import load_scene
from sehdr_warp.synth import render
from sehdr_warp.synth.expose import expose
from tests import refusals
from tests.refusals import call


def refused(capfd, *arguments):
    return refusals.refused(capfd, "synth", *arguments)


def test_expose_writes_a_set_of_five_exposures(truth, tmp_path, capfd):
    folder, _, _ = truth
    out = tmp_path / "photos"
    assert call("synth", "expose", folder, "--out", out, "--response", "srgb") == 0
    assert "6 views" in capfd.readouterr().out
    truths = load_scene(folder)
    for index in range(5):
        scene = load_scene(out, exposure_index=index)
        again = expose(truths, response_by_name("srgb"), scene.views[0].exposure_time)
        for a, b in zip(scene.views, again.views, strict=True):
            assert a.name == b.name and np.abs(a.image - b.image).max() <= 1.001 / 255
            np.testing.assert_allclose(a.hdr, b.hdr, rtol=6e-4)
    assert len(list(out.glob("train/*.png"))) == 15 and len(scene.points) == 200


def test_expose_takes_times_and_noise(truth, tmp_path):
    folder, _, _ = truth
    call("synth", "expose", folder, "--out", tmp_path / "clean", "--exposures", "0.5,4")
    call("synth", "expose", folder, "--out", tmp_path / "noisy", "--exposures", "0.5,4", "--noise", "2000,5")
    clean, noisy = (load_scene(tmp_path / name, exposure_index=1) for name in ("clean", "noisy"))
    assert clean.views[0].exposure_time == noisy.views[0].exposure_time == 4
    assert 0.5 / 255 < np.abs(clean.views[0].image - noisy.views[0].image).mean() < 0.2


def test_expose_tells_what_was_repaired_in_a_response_file(truth, tmp_path, capfd):
    path = tmp_path / "camera.csv"
    path.write_text("0 0\n0.5 0.6\n0.5 0.8\n1 1\n")
    assert call("synth", "expose", truth[0], "--out", tmp_path / "photos", "--response", path, "--exposures", "1") == 0
    assert f"{path}: exposures were not increasing; sorted" in capfd.readouterr().err


def test_expose_refuses_in_a_line(truth, tmp_path, capfd):
    folder, _, _ = truth
    out = tmp_path / "photos"
    assert "--exposures" in refused(capfd, "expose", folder, "--out", out, "--exposures", "fast")
    assert "no exposure above 0" in refused(capfd, "expose", folder, "--out", out, "--exposures", "0")
    assert "--noise" in refused(capfd, "expose", folder, "--out", out, "--noise", "100")
    assert "kodak" in refused(capfd, "expose", folder, "--out", out, "--response", "kodak")
    assert "not found" in refused(capfd, "expose", tmp_path / "none", "--out", out)
    assert not out.exists()
    assert call("synth", "expose", folder, "--out", out, "--exposures", "1") == 0
    assert "exists already" in refused(capfd, "expose", folder, "--out", out, "--exposures", "1")
    assert call("synth", "expose", folder, "--out", out, "--exposures", "2", "--overwrite") == 0
    assert load_scene(out).views[0].exposure_time == 2


def test_pack_says_what_it_costs(truth, tmp_path, capfd):
    folder, _, _ = truth
    assert call("synth", "pack", folder, "--out", tmp_path / "small", "--compression", "zip") == 0
    assert "mu-law" in capfd.readouterr().out
    assert "exists already" in refused(capfd, "pack", folder, "--out", tmp_path / "small")
    assert "no finished set" in refused(capfd, "pack", tmp_path, "--out", tmp_path / "other")


def test_render_refuses_in_a_line(tmp_path, capfd):
    assert "take one of study" in refused(capfd, "render", "castle", "--out", tmp_path)
    assert "--size 200" in refused(capfd, "render", "study", "--out", tmp_path, "--size", "200")
    assert "--views" in refused(capfd, "render", "study", "--out", tmp_path, "--views", "35")
    assert "--samples" in refused(capfd, "render", "study", "--out", tmp_path, "--samples", "1")


def test_a_missing_renderer_is_named_with_its_remedy(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda name: None)
    assert "pip install 'sehdr-warp[synth]'" in refused(capfd, "render", "study", "--out", tmp_path)
    assert not any(tmp_path.iterdir())
