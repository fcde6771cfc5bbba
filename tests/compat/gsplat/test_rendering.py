"""gsplat's rasterization(), made of ours: images, gradients, batches, and splatfacto's call."""

import pytest
import torch

from sehdr_warp.compat.gsplat import quat_scale_to_covar_preci, rasterization
from sehdr_warp.rasterizer import rasterize, spherical_harmonics

from .scenes import COUNT, HEIGHT, WIDTH, scene


def alone(leaves, place, camera, features=None, **options):
    means, quaternions, scales, opacities, colors = leaves
    pose, lens = place[0][camera], torch.tensor([40.0, 42.0, 20.0, 15.0], device=means.device)
    features = colors if features is None else features
    return rasterize(means, scales.log(), quaternions, opacities, features, pose, lens, WIDTH, HEIGHT, **options)


def test_cameras_in_one_call_are_those_of_each_alone(device):
    leaves, place = scene(device)
    background = torch.tensor([[0.2, 0.4, 0.8], [1.0, 0.0, 0.5]], device=device)
    options = {"packed": False, "backgrounds": background, "render_mode": "RGB+ED"}
    colors, alphas, info = rasterization(*leaves, **place._asdict(), **options)
    info["means2d"].retain_grad()
    colors.square().sum().backward()
    together = [leaf.grad.clone() for leaf in leaves]
    assert colors.shape == (2, HEIGHT, WIDTH, 4) and alphas.shape == (2, HEIGHT, WIDTH, 1)
    for leaf in leaves:
        leaf.grad = None
    for camera in range(2):
        own = alone(leaves, place, camera, background=background[camera], depth=True)
        own.means2d.retain_grad()
        expected = own.depth / own.alpha.clamp_min(1e-10)
        whole = torch.cat([own.image, expected[..., None]], dim=-1)
        torch.testing.assert_close(colors[camera], whole)
        torch.testing.assert_close(alphas[camera, ..., 0], own.alpha)
        torch.testing.assert_close(info["radii"][camera], own.extents.ceil().int())
        whole.square().sum().backward()
        torch.testing.assert_close(info["means2d"].grad[camera], own.means2d.grad, rtol=1e-3, atol=1e-4)
    for values, leaf in zip(together, leaves, strict=True):
        torch.testing.assert_close(values, leaf.grad, rtol=1e-3, atol=1e-3)


def test_harmonics_depths_and_the_far_plane(device):
    leaves, place = scene(device, coefficients=9)
    means, coefficients = leaves[0], leaves[4]
    colors, _, info = rasterization(*leaves, **place._asdict(), packed=False, sh_degree=2)
    eye = torch.tensor([0.0, 0.0, -4.0], device=device)
    lit = (spherical_harmonics(2, coefficients, means, eye) + 0.5).clamp_min(0)
    torch.testing.assert_close(colors[1], alone(leaves, place, 1, lit).image)
    depths, _, _ = rasterization(*leaves, **place._asdict(), sh_degree=2, render_mode="D", far_plane=3.0)
    assert depths.shape == (2, HEIGHT, WIDTH, 1)
    near = (means[:, 2] + 3.0 <= 3.0).nonzero()[:, 0]
    near_leaves = [leaf[near] for leaf in leaves]
    torch.testing.assert_close(depths[0, ..., 0], alone(near_leaves, place, 0, lit[near], depth=True).depth)
    assert info["n_cameras"] == 2 and info["width"] == WIDTH and info["means2d"].shape == (2, COUNT, 2)


def test_batch_axes_are_scenes_of_their_own(device):
    leaves, place = scene(device)
    pose, lens = place[:2]
    others = [leaf.detach() * 0.9 for leaf in leaves]
    stacked = [torch.stack([leaf, other])[None] for leaf, other in zip(leaves, others, strict=True)]
    cameras = [tensor.expand(1, 2, *tensor.shape) for tensor in (pose, lens)]
    backgrounds = torch.rand(1, 2, 2, 3, generator=torch.Generator().manual_seed(5)).to(device)
    for packed in (True, False):
        colors, alphas, info = rasterization(
            *stacked,
            viewmats=cameras[0],
            Ks=cameras[1],
            width=WIDTH,
            height=HEIGHT,
            packed=packed,
            backgrounds=backgrounds,
            render_mode="RGB+D",
        )
        assert colors.shape == (1, 2, 2, HEIGHT, WIDTH, 4) and alphas.shape == (1, 2, 2, HEIGHT, WIDTH, 1)
        assert info["n_batches"] == 2 and info["n_cameras"] == 2
        for index, inputs in enumerate((leaves, others)):
            options = {"backgrounds": backgrounds[0, index], "render_mode": "RGB+D"}
            truth, _, _ = rasterization(*inputs, **place._asdict(), **options)
            torch.testing.assert_close(colors[0, index], truth)
        if packed:
            assert set(info["batch_ids"].tolist()) == {0, 1}
        else:
            assert info["means2d"].shape == (1, 2, 2, COUNT, 2) and info["radii"].shape == (1, 2, 2, COUNT, 2)
            info["means2d"].retain_grad()
            colors.sum().backward()
            assert (info["means2d"].grad != 0).any(-1).any(-1).all()


def test_scenes_can_share_coefficients(device):
    leaves, place = scene(device, coefficients=4)
    *splats, coefficients = [torch.stack([leaf, leaf * 0.9]) for leaf in leaves]
    cameras = {"viewmats": place[0].expand(2, *place[0].shape), "Ks": place[1].expand(2, *place[1].shape)}
    size = {"width": WIDTH, "height": HEIGHT, "sh_degree": 1}
    shared, _, _ = rasterization(*splats, leaves[-1], **cameras, **size)
    truth, _, _ = rasterization(*splats, coefficients[:1].expand_as(coefficients), **cameras, **size)
    assert torch.equal(shared, truth)


def test_colors_of_each_camera(device):
    leaves, place = scene(device, coefficients=4)
    coefficients = torch.stack([leaves[4].detach(), -leaves[4].detach()])
    colors, _, _ = rasterization(*leaves[:4], coefficients, **place._asdict(), sh_degree=1)
    plain, _, _ = rasterization(*leaves[:4], coefficients[:, :, 0], **place._asdict())
    for camera in range(2):
        one, _, _ = rasterization(*leaves[:4], coefficients[camera], **place._asdict(), sh_degree=1)
        torch.testing.assert_close(colors[camera], one[camera])
        one, _, _ = rasterization(*leaves[:4], coefficients[camera, :, 0], **place._asdict())
        torch.testing.assert_close(plain[camera], one[camera])


@pytest.mark.parametrize("packed", [True, False])
def test_a_background_of_all_cameras_and_depths_beside_no_channel(packed, device):
    leaves, place = scene(device)
    behind, options = torch.tensor([0.2, 0.4, 0.8], device=device), {"packed": packed, "render_mode": "RGB+ED"}
    shared, _, _ = rasterization(*leaves, **place._asdict(), **options, backgrounds=behind)
    truth, _, _ = rasterization(*leaves, **place._asdict(), **options, backgrounds=behind.expand(2, 3))
    assert torch.equal(shared, truth)
    nothing = leaves[4][:, :0], behind.new_zeros(2, 0)
    depths, _, _ = rasterization(*leaves[:4], nothing[0], **place._asdict(), **options, backgrounds=nothing[1])
    torch.testing.assert_close(depths, truth[..., 3:])


@pytest.mark.parametrize("packed", [True, False])
def test_extra_signals_and_depths_without_colors(packed, device):
    leaves, place = scene(device, coefficients=4)
    shapes = leaves[:4]
    each = torch.rand(2, COUNT, 2, generator=torch.Generator().manual_seed(4)).to(device)
    behind = torch.rand(2, 5, generator=torch.Generator().manual_seed(5)).to(device)
    options = {"packed": packed, "render_mode": "RGB+ED", "sh_degree": 1}
    plain, _, info = rasterization(*leaves, **place._asdict(), **options, backgrounds=behind[:, :3])
    assert "render_extra_signals" not in info
    colors, alphas, info = rasterization(*leaves, **place._asdict(), **options, backgrounds=behind, extra_signals=each)
    torch.testing.assert_close(colors, plain)
    extra, _, _ = rasterization(*shapes, each, **place._asdict(), backgrounds=behind[:, 3:])
    torch.testing.assert_close(info["render_extra_signals"], extra)
    depths, same, info = rasterization(
        *shapes, None, **place._asdict(), packed=packed, render_mode="ED", extra_signals=each[0], tile_size=None
    )
    torch.testing.assert_close(depths, colors[..., 3:])
    torch.testing.assert_close(same, alphas)
    extra, _, _ = rasterization(*shapes, each[0], **place._asdict())
    torch.testing.assert_close(info["render_extra_signals"], extra)
    assert info["tile_size"] == 16
    with pytest.raises(TypeError, match="colors is None, and render_mode 'RGB' renders them"):
        rasterization(*shapes, None, **place._asdict())


def test_splatfactos_call(device):
    """nerfstudio's call with its defaults, absolute gradients among them."""
    leaves, place = scene(device, coefficients=16)
    logits = torch.logit(leaves[3].detach().clamp(0.01, 0.99))[:, None].requires_grad_()
    camera = place[0][:1], place[1][:1]
    render, alpha, info = rasterization(
        means=leaves[0],
        quats=leaves[1],
        scales=torch.exp(leaves[2].detach().log()),
        opacities=torch.sigmoid(logits).squeeze(-1),
        colors=leaves[4],
        viewmats=camera[0],
        Ks=camera[1],
        width=WIDTH,
        height=HEIGHT,
        packed=False,
        near_plane=0.01,
        far_plane=1e10,
        render_mode="RGB+ED",
        sh_degree=3,
        sparse_grad=False,
        absgrad=True,
        rasterize_mode="classic",
    )
    info["means2d"].retain_grad()
    (render[..., :3].mean() + alpha.mean()).backward()
    assert render.shape == (1, HEIGHT, WIDTH, 4) and alpha.shape == (1, HEIGHT, WIDTH, 1)
    absolute, plain = info["means2d"].absgrad, info["means2d"].grad
    assert absolute.shape == plain.shape == (1, COUNT, 2)
    assert bool((absolute >= plain.abs() * 0.999 - 1e-9).all()) and bool((absolute > 0).any())


def test_antialiasing_is_differentiated_whole(device):
    """Compare with gradients of torch's operations, by which covariances are projected."""
    leaves, place = scene(device)
    leaves = [leaf.detach().double().requires_grad_() for leaf in leaves]
    place = place._replace(viewmats=place.viewmats.double(), Ks=place.Ks.double())
    gradients_of = []
    for by_covariances in (False, True):
        means, quats, scales, opacities, colors = leaves
        covars, _ = quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        shapes = (None, None) if by_covariances else (quats, scales)
        values = {"covars": covars} if by_covariances else {}
        image, _, _ = rasterization(
            means, *shapes, opacities, colors, **place._asdict(), rasterize_mode="antialiased", packed=False, **values
        )
        gradients_of.append(torch.autograd.grad(image.square().sum(), leaves))
    for ours, true in zip(*gradients_of, strict=True):
        assert float((ours - true).norm() / true.norm()) < 1e-4
