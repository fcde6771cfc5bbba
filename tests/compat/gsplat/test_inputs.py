"""Arguments of gsplat's rasterization(): misfits are named, and what is out of range changes nothing else."""

import inspect
from pathlib import Path

import pytest
import torch

from sehdr_warp.compat.gsplat import rasterization
from sehdr_warp.compat.gsplat.inputs import UNSUPPORTED

from .scenes import COUNT, HEIGHT, WIDTH, gradients, scene


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sparse_grad": True}, "sparse_grad = True is not supported, expected False"),
        ({"viewmats_rs": torch.zeros(2, 4, 4)}, r"viewmats_rs = a tensor of shape \[2, 4, 4\] is not supported"),
        ({"rolling_shutter": 0}, "rolling_shutter = 0 is not supported"),
        ({"camera_model": "ftheta"}, "camera_model 'ftheta' is none of pinhole, ortho, fisheye"),
        ({"render_mode": "rgb"}, "render_mode 'rgb' is none of RGB"),
        ({"rasterize_mode": "fast"}, "rasterize_mode 'fast' is none of classic, antialiased"),
        ({"eps2d": -0.1}, "eps2d -0.1 is not a number from 0"),
        ({"tile_size": 0}, "tile_size 0 is not in 1.."),
        ({"far_plane": "10"}, "far_plane is '10', expected a number"),
        ({"sh_degree": 5}, r"sh_degree 5 is not in 0\.\.4"),
        ({"sh_degree": 2}, "colors has shape .* but sh_degree 2 needs 9 coefficients"),
        ({"backgrounds": torch.zeros(2, 4)}, "backgrounds has shape"),
        ({"rays": torch.zeros(2, 30, 40, 6)}, r"rays = a tensor of shape \[2, 30, 40, 6\] is not supported"),
        ({"extra_signals": torch.zeros(3, 1)}, r"extra_signals has shape \[3, 1\], expected \[N, E\] with N = 200"),
        ({"far": 3}, "unexpected keyword argument 'far'"),
    ],
)
def test_what_is_not_supported_is_named(options, message):
    leaves, place = scene(coefficients=4 if "sh_degree" in options else 0)
    with pytest.raises((ValueError, TypeError), match=message):
        rasterization(*leaves, **place._asdict(), **options)


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_each_argument_without_effect_is_refused_by_name(name):
    leaves, place = scene()
    with pytest.raises(ValueError, match=f"^{name} = .* is not supported, expected {UNSUPPORTED[name]}$"):
        rasterization(*leaves, **place._asdict(), **{name: not UNSUPPORTED[name]})


def test_the_page_for_users_of_gsplat_has_each_argument():
    page = (Path(__file__).parents[3] / "docs" / "gsplat.md").read_text()
    names = [*inspect.signature(rasterization).parameters, *UNSUPPORTED]
    assert [name for name in names if f"`{name}" not in page] == ["unsupported"]


def test_wrong_shapes_types_and_devices_are_named():
    leaves, place = scene()
    for index, bad, message in (
        (0, leaves[0][:, :2], r"means has shape \[200, 2\], expected \[N, 3\]"),
        (1, leaves[1].double(), "quats is torch.float64"),
        (3, leaves[3][:, None], "opacities has shape"),
        (5, place[0][0], "viewmats has shape"),
        (6, place[1].half(), "Ks is torch.float16, expected torch.float32 or torch.float64"),
        (6, [[1.0]], "Ks is a list"),
        (4, leaves[4][:, :0], r"colors has shape \[200, 0\], which has no channel"),
    ):
        arguments = [*leaves, *place]
        arguments[index] = bad
        with pytest.raises((ValueError, TypeError), match=message):
            rasterization(*arguments)
    with pytest.raises(ValueError, match=r"viewmats has shape \[0, 2, 4, 4\], which has no camera"):
        none = place._replace(viewmats=place.viewmats[None][:0], Ks=place.Ks[None][:0])
        rasterization(*(leaf[None][:0] for leaf in leaves), **none._asdict())


@pytest.mark.parametrize("options", [{}, {"camera_model": "ortho"}, {"sh_degree": 1}])
def test_inputs_that_are_not_contiguous_give_the_same(options, device):
    leaves, place = scene(device, coefficients=4 if "sh_degree" in options else 0)
    truth, _, _ = rasterization(*leaves, **place._asdict(), **options)
    expected = gradients(truth, leaves)
    strided = [torch.stack([leaf.detach()] * 2, dim=-1)[..., 0].requires_grad_() for leaf in leaves]
    transposed = place._replace(viewmats=place.viewmats.mT.contiguous().mT, Ks=place.Ks.mT.contiguous().mT)
    assert not any(tensor.is_contiguous() for tensor in [*strided, transposed.viewmats, transposed.Ks])
    colors, _, _ = rasterization(*strided, **transposed._asdict(), **options)
    assert torch.equal(colors, truth)
    for mine, its in zip(gradients(colors, strided), expected, strict=True):
        torch.testing.assert_close(mine, its, rtol=1e-5, atol=1e-4)  # A GPU adds in another order each time.


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_gaussians_that_are_not_finite_change_no_gradient(model, value, device):
    options = {"camera_model": model, "rasterize_mode": "antialiased"}
    leaves, place = scene(device)
    for tensor in place[:2]:
        tensor.requires_grad_()
    good = [leaf.detach()[5:].requires_grad_() for leaf in leaves]
    truth, _, _ = rasterization(*good, **place._asdict(), **options)
    expected = gradients(truth, [*good, *place[:2]])
    for index in range(5):
        bad = [leaf.detach().clone() for leaf in leaves]
        bad[index][:5] = value
        bad = [tensor.requires_grad_() for tensor in bad]
        colors, _, _ = rasterization(*bad, **place._asdict(), **options)
        torch.testing.assert_close(colors, truth)
        for mine, its in zip(gradients(colors, [*bad, *place[:2]]), expected, strict=True):
            in_view = mine[5:] if len(mine) == COUNT else mine
            torch.testing.assert_close(in_view, its, rtol=1e-3, atol=1e-3)
            assert len(mine) != COUNT or not mine[:5].any()


def test_no_gaussians_and_cameras_that_are_singular_show_the_background(device):
    leaves, place = scene(device)
    background = torch.tensor([[0.2, 0.4, 0.8]] * 2, device=device)
    for packed in (True, False):
        none = [leaf[:0] for leaf in leaves]
        colors, alphas, _ = rasterization(*none, **place._asdict(), packed=packed, backgrounds=background)
        assert torch.equal(colors, background[:, None, None].expand_as(colors)) and bool((alphas == 0).all())
        poses = torch.zeros_like(place[0])
        colors, _, _ = rasterization(*leaves, poses, place.Ks, WIDTH, HEIGHT, packed=packed, backgrounds=background)
        assert torch.equal(colors, background[:, None, None].expand_as(colors))


@pytest.mark.parametrize("name", ["viewmats", "Ks"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_cameras_that_are_not_finite_are_named(name, value):
    leaves, place = scene("cpu")
    bad = getattr(place, name).clone()
    bad[1, 0, 2] = value
    for model in ("pinhole", "fisheye"):
        arguments = place._replace(**{name: bad})._asdict() | {"camera_model": model}
        with pytest.raises(
            ValueError, match=rf"^{name}\[1\] has a number that is not finite, expected finite numbers$"
        ):
            rasterization(*leaves, **arguments)


def test_sizes_of_nothing_and_opacities_beyond_one_are_gsplats(device):
    leaves, place = scene(device)
    with torch.no_grad():
        leaves[2][0], leaves[2][1] = 0.0, -leaves[2][1]
        leaves[3][:] = torch.linspace(0, 1.4, COUNT)
    colors, _, info = rasterization(*leaves, **place._asdict(), packed=False)
    grads = gradients(colors, leaves)
    assert all(bool(gradient.isfinite().all()) for gradient in grads)
    assert bool((grads[2][0] == 0).all()) and bool((info["radii"][0, 1] > 0).all())
    assert bool((info["radii"][:, 0] == 0).all()), "an opacity of 0"
    with torch.no_grad():
        leaves[2][1] = -leaves[2][1]
    torch.testing.assert_close(rasterization(*leaves, **place._asdict())[0], colors)
    exact = place._replace(viewmats=place.viewmats.double(), Ks=place.Ks.double())
    truth, _, _ = rasterization(*(leaf.double() for leaf in leaves), **exact._asdict())
    torch.testing.assert_close(colors.double(), truth, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_radius_of_more_pixels_than_int32_holds_is_visible(dtype, device):
    mean, quat = torch.tensor([[0.0, 0, 1]], dtype=dtype), torch.tensor([[1.0, 0, 0, 0]], dtype=dtype)
    size, half = torch.full((1, 3), 2e7, dtype=dtype), torch.full((1,), 0.5, dtype=dtype)
    pose, lens = torch.eye(4, dtype=dtype)[None], torch.diag(torch.tensor([50.0, 50, 1], dtype=dtype))[None]
    inputs = [tensor.to(device) for tensor in (mean, quat, size, half, torch.ones(1, 1, dtype=dtype), pose, lens)]
    colors, _, info = rasterization(*inputs, 32, 32, packed=False)
    assert float((colors - 0.5).abs().max()) < 1e-6 and bool((info["radii"] == 1 << 30).all())
