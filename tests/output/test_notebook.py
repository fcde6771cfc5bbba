"""A run in a notebook."""

import base64
import html
import re
import zlib

import numpy as np

from sehdr_warp.output.notebook import run_html

from .helpers import AnalyticRun, validate


def test_a_run_shows_itself_in_a_notebook():
    run = AnalyticRun()
    text = run_html(run)
    page = html.unescape(re.fullmatch(r'<iframe srcdoc="([^"]*)" [^<>]*sandbox[^<>]*></iframe>', text)[1])
    validate(page)
    assert "1,234 Gaussians" in page and "t_0" in page and not re.findall(r"https?://", page)
    packed = re.search(r'data-light="scene">([^<]*)<', page)[1]
    light = np.frombuffer(zlib.decompress(base64.b64decode(packed)), "<f2").reshape(24, 32, 3)
    np.testing.assert_allclose(light, run.render(run.cameras[3].camera).hdr * 0.5, rtol=1e-3)
    run.cameras = []
    assert "dial" in run_html(run) and "data-light=" not in run_html(run).replace("script[data-light]", "")
