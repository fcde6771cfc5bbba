"""Denoising: what guides it, what it keeps, and what it says (the filter itself where pyoidn is)."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from scenes.generator import render
from scenes.generator.recipes import RECIPES, make_cameras
from scenes.generator.render import Settings, _render_view, denoise, guide_items, load_mitsuba, render_scene
from scenes.generator.stage import Stage
from sehdr_warp.errors import SehdrError
from sehdr_warp.scene.hdr_files import read_hdr
from sehdr_warp.synth.expose import truth_path


def reflectance(item):
    assert item["bsdf"]["type"] == "twosided" and item["bsdf"]["layer"]["type"] == "diffuse"
    return item["bsdf"]["layer"]["reflectance"]


def test_guides_see_albedo_and_white_for_what_has_none(tmp_path):
    stage = Stage(SimpleNamespace(), np.random.default_rng(0), tmp_path)
    paint, white = {"type": "rgb", "value": [0.2, 0.3, 0.4]}, [1.0, 1.0, 1.0]
    for material in (stage.matt([0.2, 0.3, 0.4]), stage.varnish([0.2, 0.3, 0.4]), stage.metal(), stage.glass()):
        stage.add(type="sphere", radius=2.0, bsdf=material)
    stage.lamp((0, 0, 1), 0.1, (50, 40, 30))
    stage.add(type="envmap", sampling_weight=1.0)
    stage.sun((0, 0, -1), (1, 1, 1))
    matt, varnished, metal, glass, lamp, sky = [
        item for item in guide_items(stage.items).values() if isinstance(item, dict)
    ]
    assert reflectance(matt) == reflectance(varnished) == paint and matt["radius"] == 2.0
    assert all(reflectance(item)["value"] == white for item in (metal, glass, lamp, sky))
    assert "emitter" not in lamp and lamp["radius"] == 0.1 and sky["type"] == "sphere" and sky["radius"] > 100
    assert "emitter" in stage.items["item_0005"], "the scene itself keeps its lights"


@pytest.fixture
def textured():
    """Checks in smooth light with noise, [96, 96, 3]: truth, rendered, albedo."""
    pytest.importorskip("pyoidn", reason="Open Image Denoise is not installed")
    rng, (y, x) = np.random.default_rng(0), np.mgrid[0:96, 0:96]
    albedo = np.where(((x // 3 + y // 3) % 2)[..., None] == 1, (0.7, 0.5, 0.3), (0.4, 0.35, 0.3)).astype(np.float32)
    truth = albedo * (0.02 * np.exp(x / 30.0))[..., None].astype(np.float32)
    return truth, (truth * rng.gamma(8.0, 1 / 8.0, truth.shape)).astype(np.float32), albedo


def test_noise_goes_and_texture_stays(textured):
    truth, rendered, albedo = textured
    facing = np.broadcast_to(np.float32([0, 0, 1]), truth.shape)
    denoised = denoise(rendered, albedo, facing, np.zeros_like(truth))
    assert denoised.dtype == np.float32 and denoised.min() >= 0
    before, after = (np.sqrt(np.mean((image / truth - 1) ** 2)) for image in (rendered, denoised))
    assert after < 0.25 * before
    blind = denoise(rendered, np.ones_like(albedo), facing, np.zeros_like(truth))
    assert after < 0.5 * np.sqrt(np.mean((blind / truth - 1) ** 2)), "the guides hold the texture"


def test_light_seen_itself_is_kept(textured):
    _, rendered, albedo = textured
    rendered[40:43, 40:43] = 5000.0
    straight = np.zeros_like(rendered)
    straight[40:43, 40:43] = 4000.0
    straight[10, 10] = 0.4 * rendered[10, 10]
    denoised = denoise(rendered, albedo, np.zeros_like(albedo), straight)
    np.testing.assert_array_equal(denoised[40:43, 40:43], rendered[40:43, 40:43])
    assert (denoised[10, 10] != rendered[10, 10]).any()


def test_an_unknown_or_missing_denoiser_is_refused(monkeypatch):
    with pytest.raises(SehdrError, match="--denoise median: is not one of none, oidn"):
        Settings(denoise="median")
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SehdrError, match="pip install pyoidn, or take --denoise none"):
        Settings(denoise="oidn")
    Settings(denoise="none")


@pytest.mark.parametrize(
    "spoilt,words", [("rendered", "view 1 has pixels"), ("denoised", "view 1, denoised, has pixels")]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_pixels_that_are_no_light_are_refused_before_and_after_denoising(tmp_path, spoilt, words, value):
    images = {name: np.ones((24, 24, 3), np.float32) for name in ("rendered", "denoised")}
    images[spoilt][3, 4] = value
    mitsuba = SimpleNamespace(
        variant=lambda: "scalar_rgb",
        load_dict=lambda item: item,
        ScalarTransform4f=lambda pose: pose,
        render=lambda *_, **__: images["rendered"],
    )
    recipe, (path, aside) = RECIPES["night"], (tmp_path / "view.exr", tmp_path / "view.npz")
    camera = make_cameras(recipe.layout, 24, 24)[1]
    with pytest.raises(SehdrError, match=f"^night: {words} that are not finite or negative; take"):
        _render_view(
            mitsuba, None, recipe, camera, 1, Settings(24, 24, 4, 0), lambda *_: images["denoised"], path, aside
        )
    assert not path.exists() and not aside.exists()
    images[spoilt][3, 4] = 1.0
    _render_view(mitsuba, None, recipe, camera, 1, Settings(24, 24, 4, 0), lambda *_: images["denoised"], path, aside)
    assert read_hdr(path).max() == 1.0


def test_a_denoised_scene_says_so_and_is_nearer_to_many_paths(tmp_path):
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    pytest.importorskip("pyoidn", reason="Open Image Denoise is not installed")
    mi, images, making = load_mitsuba("scalar_rgb"), {}, {}
    for kind, samples in (("none", 64), ("oidn", 4)):
        folder = render_scene(mi, RECIPES["study"], tmp_path / kind, Settings(24, 24, samples, 0, (0,), kind))
        images[kind] = read_hdr(truth_path(folder, "train", 0))
        making[kind] = json.loads((folder / "synth.json").read_text())
    assert "denoiser" not in making["none"] and making["none"]["denoise"] == "none"
    assert "Open Image Denoise" in making["oidn"]["denoiser"] and making["oidn"]["denoise"] == "oidn"
    scale = images["none"].max()
    few, many = (np.log1p(5000 * images[kind] / scale) / np.log1p(5000) for kind in ("oidn", "none"))
    assert -10 * np.log10(np.mean((few - many) ** 2)) > making["oidn"]["noise_db"] + 1
