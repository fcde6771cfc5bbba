"""Textures, shapes and cameras (always), and the scenes themselves (where Mitsuba is)."""

import json

import numpy as np
import pytest

from scenes.generator import render, textures
from scenes.generator.recipes import RECIPES
from scenes.generator.render import Settings, load_mitsuba
from sehdr_warp.errors import InputError
from tests.make_scenes import load

TEXTURES = ("wood", "brick", "checker", "wallpaper", "plaster", "painting", "globe", "ground", "books")


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_are_reflectances_with_detail_and_repeat(name):
    make = getattr(textures, name)
    image, again, other = (make(np.random.default_rng(seed)) for seed in (0, 0, 1))
    assert image.dtype == np.float32 and image.shape[2] == 3
    assert image.min() > 0 and image.max() < 0.9 and image.std() > 0.02
    np.testing.assert_array_equal(image, again)
    assert (image != other).any()


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
