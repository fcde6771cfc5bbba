"""The field: colour models, tone maps, brackets, exposures, and what a render of them means."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.model.exposure import exposure_times
from sehdr_warp.model.fusion import NeuralExposureFusion
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.model.renders import CameraTensors
from sehdr_warp.rasterizer import rasterize
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.run_folder import CameraEntry
from sehdr_warp.scene import Camera

from ..training.toy import orbit_camera, toy_field

TIME = 0.25
SRGB = response_by_name("srgb")
CAMERA = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, np.eye(4))


def wall(exposure, radiance="log", depth=3.0, **options):
    """One opaque Gaussian, so large and so near that it fills the image with one exposure."""
    value = math.log(exposure) if radiance == "log" else exposure
    gaussians = Gaussians.from_points(torch.tensor([[0.0, 0.0, depth]]), torch.full((1, 3), value), 0, opacity=0.99)
    gaussians.overwrite({"log_scales": torch.full((1, 3), 4.0), "opacity_logits": torch.full((1,), 12.0)})
    return RadianceField(gaussians, SRGB, base_time=TIME, color_model=radiance, **options)


def photograph(field, time=TIME, **options):
    return field.render_photo(CameraTensors.of(CAMERA, "cpu"), time, **options)


@pytest.mark.parametrize("radiance", ["log", "linear"])
@pytest.mark.parametrize("tone_map", ["pixel", "gaussian"])
def test_a_wall_has_the_radiance_it_was_given(radiance, tone_map):
    field = wall(0.2, radiance, tone_map=tone_map)
    view = field.render(CAMERA)
    centre, coverage = view.hdr[12, 16], float(view.alpha[12, 16])
    torch.testing.assert_close(centre, torch.full((3,), 0.2 / TIME * coverage), rtol=1e-4, atol=0)
    assert float(view.depth[12, 16]) == pytest.approx(3.0, rel=1e-4) and coverage > 0.98
    for time in (TIME / 2, TIME, 2 * TIME):
        expected = float(SRGB.encode(torch.tensor(0.2 * time / TIME * coverage)))
        tolerance = 1e-4 if tone_map == "pixel" else 0.01
        assert float(photograph(field, time).encoded.detach()[12, 16, 0]) == pytest.approx(expected, abs=tolerance)


def test_display_colours_are_encoded_values():
    field = wall(0.6 - 0.5, "display")
    coverage = float(field.render(CAMERA).alpha[12, 16])
    assert float(photograph(field).encoded.detach()[12, 16, 1]) == pytest.approx(0.6 * coverage, rel=1e-4)
    decoded = float(SRGB.decode(torch.tensor(0.6 * coverage))) / TIME
    assert float(field.render(CAMERA).hdr[12, 16, 1]) == pytest.approx(decoded, rel=1e-4)
    brighter = float(SRGB.encode(torch.tensor(decoded * TIME * 1.5)))
    assert float(photograph(field, 1.5 * TIME).encoded.detach()[12, 16, 1]) == pytest.approx(brighter, abs=1e-4)


def test_a_fisheye_lens_shows_nothing_beyond_its_border():
    """theta - 0.1 theta^3 is largest at 105 degrees, 73 pixels from the middle."""
    wide = Camera(200, 160, 60.0, 60.0, 100.0, 80.0, np.eye(4), "SIMPLE_RADIAL_FISHEYE", (-0.1,))
    field = toy_field()
    y, x = np.mgrid[:160, :200] + 0.5
    radius = np.hypot(x - 100, y - 80)
    placed = replace(wide, world_to_camera=orbit_camera(0.0, 32).world_to_camera)
    view, photo = field.render(placed), field.render_ldr(placed).numpy()
    alpha = view.alpha.numpy()
    assert alpha[radius < 20].max() > 0.5
    for picture in (alpha, view.depth.numpy(), view.hdr.numpy().max(2), photo.max(2)):
        assert not picture[radius > 75].any()


def test_a_view_in_place_of_its_camera_is_refused_by_name():
    entry, field = CameraEntry("a", "train", CAMERA, TIME), wall(0.2)
    for render in (field.render, field.render_ldr):
        with pytest.raises(TypeError, match=r"camera is a CameraEntry, expected a Camera, as run.cameras\[0\].camera"):
            render(entry)


def test_ldr_is_limited_and_training_goes_on_beyond_white():
    field = wall(9.0)
    assert float(field.render_ldr(CAMERA).max()) == 1.0
    photo = photograph(field).encoded
    assert float(photo.detach()[12, 16, 0]) > 1.0
    photo.sum().backward()
    assert float(field.gaussians.harmonics_dc.grad.min()) > 0


def test_black_pixels_have_finite_gradients():
    field = wall(0.2)
    field.gaussians.overwrite({"log_scales": torch.full((1, 3), -3.0)})
    photo = photograph(field)
    assert (photo.encoded == 0).any()
    photo.encoded.sum().backward()
    gradients = {name: p.grad for name, p in field.gaussians.named_parameters() if p.numel()}
    assert gradients["harmonics_dc"].any() and all(torch.isfinite(gradient).all() for gradient in gradients.values())


def fusion_of():
    times = exposure_times(TIME, ("1/8x", "1x", "8x"))
    return NeuralExposureFusion(SRGB, times, TIME, width=8, radiance_scale=1 / TIME)


@pytest.mark.parametrize("tone_map,channels", [("pixel", 6), ("gaussian", 9)])
def test_brackets_share_one_rasterisation(tone_map, channels):
    calls = []

    def counted(*arguments, **options):
        calls.append(arguments[4].shape[1])
        return rasterize(*arguments, **options)

    field = wall(0.2, tone_map=tone_map, fusion=fusion_of())
    field.rasterizer = counted
    photo = photograph(field, extra_images=frozenset({"base", "exposure"}))
    assert calls == [channels]
    assert photo.encoded.shape == photo.exposure.shape == photo.base.shape == (24, 32, 3)


def test_fused_radiance_is_neefs():
    fusion = fusion_of()
    field = wall(0.2, fusion=fusion)
    with torch.no_grad():
        expected = fusion(torch.full((1, 3), math.log(0.2)))[0]
    photo = photograph(field, extra_images=frozenset({"base", "exposure"}))
    coverage = float(photo.rendering.alpha.detach()[12, 16])
    torch.testing.assert_close(photo.exposure.detach()[12, 16], expected * TIME * coverage, rtol=1e-4, atol=0)
    torch.testing.assert_close(photo.base.detach()[12, 16], torch.full((3,), 0.2 * coverage), rtol=1e-4, atol=0)
    (photo.exposure.sum()).backward()
    assert all(p.grad is not None for p in fusion.parameters())
