"""Rendered scenes (where Mitsuba is), and denoising: what guides it, what it keeps, what it refuses."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from scenes.generator import render
from scenes.generator.recipes import RECIPES, make_cameras
from scenes.generator.render import Settings, denoise, load_mitsuba, render_view
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.scene.images.hdr_files import read_hdr
from tests.make_scenes import load


@pytest.fixture(scope="module")
def mitsuba():
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    return load_mitsuba("scalar_rgb")


@pytest.fixture(scope="module")
def rendered(mitsuba, tmp_path_factory):
    """The smallest scene, three views of 24 x 24 pixels."""
    settings = Settings(24, 24, 8, 5, (0, 1, 34))
    return render.render_scene(mitsuba, RECIPES["night"], tmp_path_factory.mktemp("synth"), settings), settings


def test_a_rendered_scene_loads(rendered):
    folder, _ = rendered
    scene = load(folder)
    assert [view.name for view in scene.train_views] == ["r_0", "r_34"]
    assert [view.name for view in scene.test_views] == ["r_1"]
    for view in scene.views:
        assert np.isfinite(view.hdr).all() and view.hdr.min() >= 0 and view.hdr.max() > 10
    making = json.loads((folder / "synth.json").read_text())
    assert making["paths_of_a_pixel"] == 16 and 10 < making["noise_db"] < 60


def test_finished_views_are_not_rendered_again(rendered, mitsuba, caplog):
    folder, settings = rendered
    path = folder / "train_hdr" / "hdr_001.exr"
    modified, before = (folder / "train_hdr" / "hdr_000.exr").stat().st_mtime_ns, load(folder).views
    path.unlink()
    caplog.set_level("INFO", logger="scenes.generator")
    render.render_scene(mitsuba, RECIPES["night"], folder.parent, settings)
    assert "view 34" in caplog.text and "view 0 of" not in caplog.text
    assert (folder / "train_hdr" / "hdr_000.exr").stat().st_mtime_ns == modified
    again = {view.name: view.hdr for view in load(folder).views}
    for view in before:
        if view.name == "r_34":  # The same things, the same light; Mitsuba may number its lights in another order.
            assert 0.9 < np.median(again["r_34"] / view.hdr) < 1.1
        else:
            np.testing.assert_array_equal(again[view.name], view.hdr)
    caplog.clear()
    render.render_scene(mitsuba, RECIPES["night"], folder.parent, settings)
    assert "things built" not in caplog.text


def test_other_settings_do_not_mix(rendered, mitsuba):
    with pytest.raises(InputError, match="other settings"):
        render.render_scene(mitsuba, RECIPES["night"], rendered[0].parent, Settings(24, 24, 9, 5, (0, 1, 34)))


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
        render_view(
            mitsuba, None, recipe, camera, 1, Settings(24, 24, 4, 0), lambda *_: images["denoised"], path, aside
        )
    assert not path.exists() and not aside.exists()
    images[spoilt][3, 4] = 1.0
    render_view(mitsuba, None, recipe, camera, 1, Settings(24, 24, 4, 0), lambda *_: images["denoised"], path, aside)
    assert read_hdr(path).max() == 1.0
