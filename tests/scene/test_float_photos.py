"""Photos in floating point and linear 16 bits."""

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.output.images.exr import rgb_channels, write_exr, write_radiance
from sehdr_warp.output.images.ldr_files import write_picture
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene import load_scene
from sehdr_warp.training.plan import make_plan
from tests.make_scenes import write_colmap

from .raw.dng_files import picture, posed


def light_of(view, scene):
    return scene.response.decode(view.codes / 65535) / view.exposure_time


@pytest.mark.parametrize("suffix, tolerance", [(".exr", 2e-3), (".hdr", 0.02)])
def test_float_pictures_are_photos_whose_light_is_known(tmp_path, suffix, tolerance):
    def write(path, i):
        if suffix == ".exr":
            write_exr(path, rgb_channels(picture(i)), pixel="float")
        else:
            write_radiance(path, picture(i))

    scene = load_scene(posed(tmp_path, write, suffix))
    assert scene.response.name == "hdr-nerf" and scene.color_matrix is None and len(scene.test_views) == 1
    for i, view in enumerate(scene.views):
        np.testing.assert_allclose(light_of(view, scene), picture(i), rtol=tolerance, atol=1e-3)
        assert view.codes.max() < 65535
        np.testing.assert_allclose(view.hdr, picture(i), rtol=tolerance)
    with pytest.raises(InputError, match="its photos are float: their light is known, and response srgb"):
        load_scene(tmp_path, response="srgb")
    config = make_plan(scene, load_config("default", {}), "cpu").config
    assert (config.loss.hdr_weight, config.loss.ldr_weight, config.loss.form) == (1, 0, "blend")


def _write_cut_out(path, light, alpha):
    import OpenEXR

    pixels = np.dstack([light * alpha[..., None], alpha]).astype(np.float32)
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {"RGBA": pixels}).write(str(path))


def test_transparency_of_openexr_counts_as_that_of_other_photos(tmp_path):
    """Alpha is a mask in photographed sets, and black light in rendered ones, whose colors it has dimmed already."""
    alpha = np.ones((24, 32), np.float32)
    alpha[:6], alpha[6:12] = 0, 0.5
    scene = load_scene(posed(tmp_path, lambda path, i: _write_cut_out(path, picture(i), alpha), ".exr"))
    assert "transparency: 6 of 6 photos have transparent pixels, which count as black light" in scene.notes
    assert scene.views[0].mask is None
    np.testing.assert_allclose(light_of(scene.views[0], scene), picture() * alpha[..., None], rtol=2e-3, atol=1e-3)
    pytest.importorskip("pycolmap")
    write_colmap(tmp_path / "set", size=(32, 24), params=(40.0, 40.0, 16.0, 12.0))
    for i in range(6):
        (tmp_path / "set" / "images" / f"{i:03d}.png").unlink()
        _write_cut_out(tmp_path / "set" / "images" / f"{i:03d}.exr", picture(i), alpha)
    scene = load_scene(tmp_path / "set")
    np.testing.assert_array_equal(scene.views[0].mask, alpha)
    np.testing.assert_allclose(light_of(scene.views[0], scene)[6:], picture()[6:], rtol=2e-3, atol=1e-3)
    assert "transparency: 6 of 6 photos have transparent pixels, which are left out" in scene.notes


def test_linear_16_bit_photos(tmp_path):
    def write(path, i):
        write_picture(path, np.rint(np.clip(picture(i) / 20, 0, 1) * 65535).astype(np.uint16))

    scene = load_scene(posed(tmp_path, write, ".png"), response="linear")
    assert scene.response.name == "srgb"
    for i, view in enumerate(scene.views):
        expected = np.clip(picture(i) / 20, 0, 1)
        expected = np.where(expected >= 0.99, 1, expected)
        np.testing.assert_allclose(light_of(view, scene), expected, atol=2e-5, rtol=1e-4)
        np.testing.assert_array_equal(view.codes == 65535, expected == 1)
