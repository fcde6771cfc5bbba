"""OpenUSD: schema, extent, and values and transforms at times."""

import re
from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.splats import read_gaussians, write_gaussians

from .samples import gaussians


def test_usd_states_the_extent_of_what_is_drawn(tmp_path):
    """Along its own axes, down to an opacity of 1/255: what viewers frame and cull by. Faint Gaussians do not count."""
    Usd = pytest.importorskip("pxr.Usd")
    written = gaussians(2, color_model="linear")
    turned = np.float32([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # A quarter about Z: the long axis is X.
    values = {
        "means": np.float32([[0, 0, 0], [9, 0, 0]]), "log_scales": np.log(np.float32([[0.1, 2, 0.3], [300, 300, 300]])),
        "quaternions": np.stack([turned, turned]), "opacity_logits": np.float32([0, -3.5]),
    }  # fmt: skip
    write_gaussians(tmp_path / "a.usdc", replace(written, **values))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    reach = np.sqrt(2 * np.log(255 * 0.5)) * np.array([2, 0.1, 0.3])
    extent = np.array(stage.GetDefaultPrim().GetAttribute("extent").Get())
    np.testing.assert_allclose(extent, [-reach, reach], rtol=1e-5)

    values["opacity_logits"] = np.float32([-3.5, -3.5])
    write_gaussians(tmp_path / "b.usdc", replace(written, **values))
    stage = Usd.Stage.Open(str(tmp_path / "b.usdc"))
    assert np.ptp(np.array(stage.GetDefaultPrim().GetAttribute("extent").Get()), axis=0).min() > 600, "all are faint"


def test_usd_is_of_the_schema_and_tagged(tmp_path):
    Usd, UsdVol = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdVol")
    UsdValidation = pytest.importorskip("pxr.UsdValidation")
    written = gaussians(color_model="linear")
    write_gaussians(tmp_path / "a.usda", written)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert Usd.ColorSpaceAPI(splat).GetColorSpaceNameAttr().Get() == "lin_rec709_scene"
    assert splat.GetRadianceSphericalHarmonicsCoefficientsAttr().GetMetadata("elementSize") == 16
    # A color is max(sum + 0.5, 0), as in 3DGS: the constant term says so.
    constant = np.array(splat.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(-1, 16, 3)[:, 0]
    np.testing.assert_allclose(constant * 0.28209479 + 0.5, written.harmonics[:, 0] * 0.28209479, atol=1e-6)
    np.testing.assert_allclose(splat.GetScalesAttr().Get(), np.exp(written.log_scales), rtol=1e-5)
    result = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators()).Validate(
        stage
    )
    assert [str(error.GetMessage()) for error in result] == []


def test_values_of_openusd_at_times_alone(tmp_path):
    pytest.importorskip("pxr")
    write_gaussians(tmp_path / "a.usda", gaussians(5, 1, "linear"))
    text = (tmp_path / "a.usda").read_text()
    sampled = re.sub(
        r"(point3f\[\] positions) = (\[.*?\])", r"\1.timeSamples = { 3: \2, 5: [(0, 0, 0)] }", text, flags=re.DOTALL
    )
    assert sampled != text
    (tmp_path / "b.usda").write_text(sampled)
    np.testing.assert_allclose(read_gaussians(tmp_path / "b.usda").means, read_gaussians(tmp_path / "a.usda").means)


@pytest.mark.parametrize("value", [" = (1, 2, 3)", ".timeSamples = { 1: (1, 2, 3), 5: (0, 0, 0) }"])
def test_transforms_of_openusd_are_named(tmp_path, value):
    pytest.importorskip("pxr")
    write_gaussians(tmp_path / "a.usda", gaussians(5, 1, "linear"))
    text = (tmp_path / "a.usda").read_text()
    moved = (
        f'double3 xformOp:translate{value}\nuniform token[] xformOpOrder = ["xformOp:translate"]\npoint3f[] positions'
    )
    (tmp_path / "b.usda").write_text(text.replace("point3f[] positions", moved, 1))
    with pytest.raises(InputError, match="moved by a transform"):
        read_gaussians(tmp_path / "b.usda")


def test_a_file_made_by_hand(shared):
    pytest.importorskip("pxr")
    minimal = read_gaussians(shared / "data" / "splats" / "handmade_minimal.usda")
    assert minimal.count == 2 and minimal.harmonics[1, 0, 0] > 10
