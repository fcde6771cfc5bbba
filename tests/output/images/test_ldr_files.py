import numpy as np
import pytest

from sehdr_warp.output.images.ldr_files import exposure_exif, quantize, write_picture
from sehdr_warp.scene.images.ldr_files import read_ldr


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
