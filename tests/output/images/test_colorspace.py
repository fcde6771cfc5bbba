"""Primaries and matrices of color spaces."""

import subprocess
import sys

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.output.images.colorspace import chromaticities, color_space, matrix_to


def test_acescg_matrix_is_the_published_one():
    # ACEScg from linear sRGB as in the OpenColorIO ACES configurations.
    published = [[0.613097, 0.339523, 0.047379], [0.070194, 0.916354, 0.013452], [0.020616, 0.109570, 0.869815]]
    np.testing.assert_allclose(matrix_to(color_space("acescg").dataset), published, atol=2e-6)
    import colour

    space = colour.RGB_COLOURSPACES["ITU-R BT.709"]
    assert chromaticities("rec709") == (*space.primaries.ravel(), *space.whitepoint)


def test_plain_output_does_without_colour_science():
    """Its import takes seconds, and leaves lines on the terminal where OpenImageIO is installed."""
    code = (
        "import sys; from sehdr_warp.output.images.exr import exr_header; "
        "from sehdr_warp.output.images.colorspace import *; "
        "exr_header(); from_rec709([1, 1, 1], 'rec709'); assert 'colour' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_unknown_color_space_lists_the_known():
    with pytest.raises(SehdrError, match="'foo' is not known; choose one of rec709, acescg"):
        color_space("foo")
    with pytest.raises(SehdrError, match="'srgb' is an encoding"):
        color_space("sRGB")
    assert color_space("AP0").name == "aces2065-1"
