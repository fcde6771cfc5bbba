import numpy as np
import pytest

from sehdr_warp.output.images.display import MIDDLE_GREY, encode_srgb, expose
from sehdr_warp.output.images.tonemap import LUMINANCE, ToneMap, fit_tone_map

from ..helpers import radiance


def test_tone_map_and_stops_do_not_depend_on_the_unit_of_radiance():
    image = radiance()
    display = fit_tone_map([image])(image)
    for unit in (1e-4, 1e4):
        np.testing.assert_allclose(fit_tone_map([image * unit])(image * unit), display, atol=1e-3)
    np.testing.assert_allclose(expose(image * 1e-3, -1, scale=3.0), encode_srgb(image * 1.5e-3), atol=1e-6)


@pytest.mark.parametrize("place", [0.2, 0.45, 0.55])
def test_the_key_is_darker_in_dark_scenes_with_highlights_and_brighter_in_bright_ones(place):
    """place: of the mean of the logarithms between the darkest and the brightest."""
    logs = 4 * np.linspace(0, 1, 10_000) ** (1 / place - 1)
    picture = np.exp2(logs).reshape(100, 100, 1).repeat(3, 2)
    key = fit_tone_map([picture]).scale * 2 ** logs.mean()
    assert key == pytest.approx(MIDDLE_GREY * 2 ** (2 * place - 1), rel=0.03)


def test_the_empty_ground_of_a_cut_out_object_does_not_count():
    """Faint haze around an object would make the object white."""
    object_alone = radiance(64, 64)
    picture, alpha = np.full((64, 320, 3), 1e-3, np.float32), np.full((64, 320), 0.01)
    picture[:, :64], alpha[:, :64] = object_alone, 1.0
    assert fit_tone_map([picture], [alpha]) == fit_tone_map([object_alone])
    assert fit_tone_map([picture]).scale > 10 * fit_tone_map([object_alone]).scale
    assert fit_tone_map([picture], [0.1 * alpha]) == fit_tone_map([picture])  # Nothing is more than half covered.


def test_a_black_ground_does_not_make_the_subject_white():
    """A subject before opaque black, as of photos on velvet, is shown one stop brighter than its photos at most."""
    subject = radiance(64, 64)
    picture, alpha = np.full((64, 320, 3), 1e-3, np.float32), np.ones((64, 320))
    picture[:, :64] = subject
    gain = fit_tone_map([subject]).scale
    assert fit_tone_map([picture], [alpha]).scale > 10 * gain
    assert fit_tone_map([picture], [alpha], gain).scale == 2 * gain
    dark = fit_tone_map([picture * 1e-3], [alpha], gain).scale  # Of photos that are too dark, whites may be white.
    assert dark == pytest.approx(2e3 / np.percentile(picture @ LUMINANCE, 99))


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
