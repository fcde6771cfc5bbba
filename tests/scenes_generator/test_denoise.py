"""Denoising: what guides it, what it keeps, and what it says (the filter itself where pyoidn is)."""

from types import SimpleNamespace

import numpy as np
import pytest

from scenes.generator.recipes import RECIPES, make_cameras
from scenes.generator.render import Settings, denoise, render_view
from sehdr_warp.errors import SehdrError
from sehdr_warp.scene.images.hdr_files import read_hdr


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
