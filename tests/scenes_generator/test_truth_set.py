"""Sets of truth alone, read by load_scene; and packed, with the cost measured."""

import json
from pathlib import Path

import numpy as np
import pytest

from scenes.generator.recipes import RECIPES
from scenes.generator.truth_set import pack_truth
from sehdr_warp.errors import InputError
from sehdr_warp.scene import embedded_scenes
from sehdr_warp.scene.dataparser import reinhard_gamma
from tests.make_scenes import load

SCENES = Path(__file__).resolve().parents[2] / "scenes"


@pytest.mark.parametrize("index", [None, 0, 4])
def test_photos_are_derived_at_the_chosen_exposure(truth, index):
    folder, views, times = truth
    scene = load(folder, exposure_index=index)
    time = times[2 if index is None else index]
    assert [view.name for view in scene.train_views] == ["r_0", "r_2", "r_4"] and len(scene.test_views) == 3
    assert not len(scene.points) and scene.exposure_times_known
    stored = {view.name: view for view in views}
    for view in scene.views:
        np.testing.assert_array_equal(view.hdr, stored[view.name].radiance)
        assert view.exposure_time == pytest.approx(time)
        expected = reinhard_gamma(view.hdr * time)
        assert np.abs(view.image - expected).max() <= 0.5 / 255 + 1e-6
        np.testing.assert_allclose(view.image * 255, np.round(view.image * 255), atol=1e-4)
        np.testing.assert_allclose(view.camera.world_to_camera, stored[view.name].camera.world_to_camera, atol=1e-9)
        assert view.camera.fx == pytest.approx(stored[view.name].camera.fx)


def test_truth_that_is_missing_or_of_another_curve_is_refused(truth):
    folder, _, _ = truth
    path = folder / "transforms_train.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps(values | {"photo_response": "kodak"}))
    with pytest.raises(InputError, match="kodak"):
        load(folder)
    path.write_text(json.dumps(values))
    (folder / "train_hdr" / "hdr_001.exr").unlink()
    with pytest.raises(InputError, match="hdr_001.exr: HDR truth not found"):
        load(folder)


@pytest.mark.parametrize("compression", ["zip", "piz"])
def test_lossless_packing_costs_half_precision_alone(truth, tmp_path, compression):
    folder, _, times = truth
    packing = pack_truth(folder, tmp_path / "small", compression=compression)
    assert packing["relative_error"] < 3e-4 and packing["mu_law_psnr"] > 85
    scene = load(tmp_path / "small")
    scale = times[2] / scene.views[0].exposure_time
    assert 0.7 <= 16 * scene.views[0].exposure_time <= 1.42 and np.log2(scale) == round(np.log2(scale))
    before = load(folder)
    for a, b in zip(scene.views, before.views, strict=True):
        np.testing.assert_allclose(a.hdr, b.hdr * scale, rtol=6e-4)
        assert np.abs(a.image - b.image).max() <= 1.001 / 255
    size = sum(path.stat().st_size for path in (tmp_path / "small").rglob("[!.]*.*") if path.name != "synth.json")
    assert packing["bytes"] == size
    assert json.loads((tmp_path / "small" / "synth.json").read_text())["packing"]["compression"] == compression


def test_packing_refuses_what_it_cannot_keep(truth, tmp_path):
    folder, _, _ = truth
    with pytest.raises(InputError, match="exists already"):
        pack_truth(folder, folder)
    (folder / "exposure_train.json").unlink()
    with pytest.raises(InputError, match="no finished set"):
        pack_truth(folder, tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("name", RECIPES)
def test_embedded_scenes_have_truth_and_a_well_exposed_photo(name):
    scene = load(f"embedded:{name}")
    assert scene.name == f"embedded:{name}"
    assert len(scene.train_views) == 18 and len(scene.test_views) == 17
    for view in scene.views:
        assert view.hdr.shape == view.image.shape == (200, 200, 3)
        assert np.isfinite(view.hdr).all() and view.hdr.min() >= 0
    making = json.loads((SCENES / name / "synth.json").read_text())
    assert making["scene"] == name and making["denoise"] == "oidn" and making["seed"] == 0
    files = [p for p in (SCENES / name).rglob("[!.]*.*") if p.name != "synth.json" and p.parent.name != "light"]
    size = sum(p.stat().st_size for p in files)
    assert size == making["packing"]["bytes"] < 2e6
    median = np.median([view.image for view in scene.train_views])
    assert 0.2 < median < 0.8


def test_scenes_lie_in_the_package_beside_it_or_where_the_environment_says(tmp_path, monkeypatch):
    assert {*embedded_scenes()} == {"room", *RECIPES}
    monkeypatch.setattr("sehdr_warp.scene.load.resources.files", lambda package: tmp_path / "site" / package)
    assert embedded_scenes() == ()
    with pytest.raises(InputError, match="embedded:study: is not here; .* get the repository's scenes/"):
        load("embedded:study")
    monkeypatch.setenv("SEHDR_SCENES", str(SCENES))
    assert {*embedded_scenes()} == {*RECIPES}
    assert load("embedded:study", max_size=16).name == "embedded:study"


def test_a_scene_that_is_not_embedded_is_refused_with_the_names():
    with pytest.raises(InputError, match="embedded:nowhere: is not here; present are .*embedded:room"):
        load("embedded:nowhere")
    with pytest.raises(InputError):
        load("embedded:../room")
    assert load("embedded:room", max_size=16).name == "embedded:room"
