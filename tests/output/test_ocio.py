"""Previews through OpenColorIO, and its names of color spaces."""

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.colorspace import SPACES, from_rec709
from sehdr_warp.output.light_pictures import display_gain
from sehdr_warp.output.ocio import ocio_view
from sehdr_warp.output.render_views import render_views

from .helpers import AnalyticRun

OCIO = pytest.importorskip("PyOpenColorIO")
CONFIG = "ocio://default"


def test_previews_are_the_view(tmp_path):
    run = AnalyticRun()
    render_views(run, tmp_path, ocio=CONFIG, view="Un-tone-mapped")
    shown = np.asarray(Image.open(tmp_path / "preview" / "t_0.png")) / 255
    light = run.render(run.cameras[3].camera).hdr * run.base_time * display_gain(run.response)
    # Without a tone map this view is sRGB's curve.
    expected = np.clip(light, 0, 1)
    expected = np.where(expected <= 0.0031308, 12.92 * expected, 1.055 * expected ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shown, expected, atol=1.5 / 255)
    other = ocio_view(CONFIG, "Display P3 - Display/ACES 2.0 - SDR 100 nits (P3 D65)")(np.full((1, 1, 3), 1e6))
    assert 0.9 < other.min() <= other.max() <= 1


def test_what_a_config_lacks_is_named(tmp_path):
    with pytest.raises(InputError, match="has no view 'x'.*Un-tone-mapped"):
        ocio_view(CONFIG, "x")
    with pytest.raises(InputError, match="has no display 'x'"):
        ocio_view(CONFIG, "x/Raw")
    (tmp_path / "a.ocio").write_text("no config")
    for name, problem in (("a.ocio", "is no OpenColorIO config"), ("b.ocio", "file not found")):
        with pytest.raises(InputError, match=problem):
            ocio_view(str(tmp_path / name), "Raw")
    (tmp_path / "raw.ocio").write_text(OCIO.Config.CreateRaw().serialize())
    with pytest.raises(InputError, match="has no role aces_interchange"):
        ocio_view(str(tmp_path / "raw.ocio"), "Raw")
    with pytest.raises(SehdrError, match="need ocio, a config, and view"):
        render_views(AnalyticRun(), tmp_path / "out", view="Raw")


def test_color_spaces_have_the_names_and_matrices_of_openexr(tmp_path):
    """colorInteropID is an identifier of the Color Interop Forum, which OpenColorIO's own spaces state."""
    config = OCIO.Config.CreateFromFile(CONFIG)
    found = {space.getInteropID(): space.getName() for space in config.getColorSpaces()}
    for space in (space for space in SPACES if space.interop_id):
        to = config.getProcessor(found["lin_rec709_scene"], found[space.interop_id]).getDefaultCPUProcessor()
        for light in np.eye(3):
            np.testing.assert_allclose(to.applyRGB(light.tolist()), from_rec709(light, space.name), atol=2e-5)
