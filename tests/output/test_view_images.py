"""AOVs of a rendered view."""

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.output.render_views import render_views

from .helpers import AnalyticRun


def test_aovs_are_parts_of_their_own(tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR")
    run = AnalyticRun()
    render_views(run, tmp_path, aovs="all", axes="scene")
    view, rendered = run.cameras[3].camera, run.render(run.cameras[3].camera)
    with OpenEXR.File(str(tmp_path / "hdr" / "t_0.exr"), separate_channels=True) as file:
        headers = {part.name(): dict(part.header) for part in file.parts}
        pixels = {name: channel.pixels for part in file.parts for name, channel in part.channels.items()}
    assert {pixels[f"N.{axis}"].dtype for axis in "XYZ"} == {np.dtype(np.float16)}
    assert list(headers) == ["rgba", "depth", "position", "normals", "alpha", "confidence", "clipped"]
    assert headers.pop("rgba")["colorInteropID"] == "lin_rec709_scene"
    assert all(h["colorInteropID"] == "data" and "chromaticities" not in h for h in headers.values())
    points = np.stack([pixels[f"position.{axis}"] for axis in "XYZ"], 2)
    np.testing.assert_allclose(np.linalg.norm(points - view.position, axis=2), pixels["distance.Z"], rtol=1e-5)
    np.testing.assert_allclose((points - view.position) @ view.world_to_camera[2, :3], rendered.depth, rtol=1e-5)
    # A plane across the view, nearly: its normal is against the axis.
    normal = np.stack([pixels[f"N.{axis}"] for axis in "XYZ"], 2)[1:-1, 1:-1]
    np.testing.assert_allclose(normal @ -view.world_to_camera[2, :3], 1, atol=2e-3)
    assert (pixels["clipped"] == 0.25).all()
    run.confident = False
    for name in ("clipped", "confidence"):
        with pytest.raises(SehdrError, match=f"AOV {name} was not measured"):
            render_views(run, tmp_path, aovs=name, overwrite=True)
    for aovs, words in (("depht", "did you mean depth"), ("alpha,alpha", "named twice")):
        with pytest.raises(SehdrError, match=words):
            render_views(run, tmp_path, aovs=aovs, overwrite=True)
