import numpy as np
import pytest

from sehdr_warp.output.images.ldr_files import exposure_exif, quantize, write_picture
from sehdr_warp.output.images.tonemap import ToneMap, encode_srgb, expose, fit_tone_map
from sehdr_warp.scene.images.ldr_files import read_ldr

from ..helpers import radiance


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("exif", [None, exposure_exif(0.5)])
def test_png_gives_back_its_codes(tmp_path, bits, exif):
    codes = np.random.default_rng(0).integers(0, 2**bits, (7, 5, 3)).astype(f"uint{bits}")
    write_picture(tmp_path / "a.png", codes, exif=exif)
    np.testing.assert_array_equal(read_ldr(tmp_path / "a.png").pixels, codes)


def test_jpeg_is_close_and_keeps_colour_detail(tmp_path):
    ramp = np.linspace(0, 255, 64)
    codes = np.stack(np.broadcast_arrays(ramp[:, None], ramp[None], 255 - ramp[:, None]), 2).astype(np.uint8)
    write_picture(tmp_path / "a.jpg", codes)
    assert np.abs(read_ldr(tmp_path / "a.jpg").pixels.astype(int) - codes).max() <= 4


def test_quantize_rounds_and_limits():
    np.testing.assert_array_equal(quantize(np.array([-1, 0, 0.4 / 255, 0.6 / 255, 1, 2.0])), [0, 0, 0, 1, 255, 255])
    assert quantize(np.array([0.5]), 16) == 32768
    with pytest.raises(ValueError, match="NaN"):
        quantize(np.array([np.nan]))
    with pytest.raises(ValueError, match="float64"):
        write_picture("never.png", np.zeros((2, 2, 3)))


def test_srgb_matches_colour_science():
    import colour

    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(encode_srgb(values), colour.models.eotf_inverse_sRGB(values), atol=1e-6)


def test_tone_map_and_stops_do_not_depend_on_the_unit_of_radiance():
    image = radiance()
    display = fit_tone_map([image])(image)
    for unit in (1e-4, 1e4):
        np.testing.assert_allclose(fit_tone_map([image * unit])(image * unit), display, atol=1e-3)
    np.testing.assert_allclose(expose(image * 1e-3, -1, scale=3.0), encode_srgb(image * 1.5e-3), atol=1e-6)


def test_tone_map_uses_the_display():
    image = radiance(64, 64)
    display = fit_tone_map([image])(image)
    assert display.min() >= 0 and 0.999 < display.max() <= 1
    assert 0.25 < display.mean() < 0.6
    # Greys keep their order and stay grey; highlights run into white.
    grey = np.repeat(np.geomspace(1e-3, 1e2, 100)[:, None], 3, axis=1).astype(np.float32)
    tones = ToneMap(0.2, 4.0)(grey)
    assert (np.diff(tones[:, 0]) >= 0).all() and np.abs(tones - tones[:, :1]).max() < 1e-6
    assert ToneMap(1.0, 4.0)(np.array([4.0, 4.0, 4.0])).min() > 0.999
    assert ToneMap(1.0, 2.0)(np.array([500.0, 50.0, 50.0])).min() > 0.99
