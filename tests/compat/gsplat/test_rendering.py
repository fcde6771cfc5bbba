"""gsplat's rasterization(), made of ours: what it takes and gives, and a training as its examples make one."""

import pickle
from typing import NamedTuple

import pytest
import torch

from sehdr_warp.compat import gsplat
from sehdr_warp.compat.gsplat import fully_fused_projection, quat_scale_to_covar_preci, rasterization
from sehdr_warp.rasterizer import rasterize, spherical_harmonics

WIDTH, HEIGHT, COUNT = 40, 30, 200


class Place(NamedTuple):
    """Cameras as gsplat's rasterization() names them."""

    viewmats: torch.Tensor
    Ks: torch.Tensor
    width: int
    height: int


def scene(device="cpu", count=COUNT, coefficients=0):
    """gsplat's arguments: two cameras before a cloud of Gaussians."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.rand(*shape, generator=generator)

    colors = random(count, coefficients, 3) - 0.5 if coefficients else random(count, 3)
    quaternions = torch.randn(count, 4, generator=generator)
    values = [random(count, 3) * 2 - 1, quaternions, 0.05 + 0.1 * random(count, 3), random(count), colors]
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, 2, 3] = torch.tensor([3.0, 4.0])
    lenses = torch.tensor([[40.0, 0, 20], [0, 42.0, 15], [0, 0, 1]]).repeat(2, 1, 1)
    leaves = [tensor.to(device).requires_grad_() for tensor in values]
    return leaves, Place(poses.to(device), lenses.to(device), WIDTH, HEIGHT)


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sparse_grad": True}, "sparse_grad = True is not supported, expected False"),
        ({"with_ut": True}, "with_ut = True is not supported"),
        ({"distributed": True}, "distributed = True is not supported"),
        ({"viewmats_rs": torch.zeros(2, 4, 4)}, r"viewmats_rs = a tensor of shape \[2, 4, 4\] is not supported"),
        ({"rolling_shutter": 0}, "rolling_shutter = 0 is not supported"),
        ({"camera_model": "ftheta"}, "camera_model 'ftheta' is none of pinhole, ortho, fisheye"),
        ({"render_mode": "rgb"}, "render_mode 'rgb' is none of RGB"),
        ({"rasterize_mode": "fast"}, "rasterize_mode 'fast' is none of classic, antialiased"),
        ({"eps2d": -0.1}, "eps2d -0.1 is not a number from 0"),
        ({"tile_size": 0}, "tile_size 0 is not in 1.."),
        ({"far_plane": "10"}, "far_plane is '10', expected a number"),
        ({"sh_degree": 4}, "sh_degree 4 is not supported, expected 0 to 3"),
        ({"sh_degree": 2}, "colors has shape .* but sh_degree 2 needs 9 coefficients"),
        ({"backgrounds": torch.zeros(2, 4)}, "backgrounds has shape"),
        ({"far": 3}, "unexpected keyword argument 'far'"),
    ],
)
def test_what_is_not_supported_is_named(options, message):
    leaves, place = scene(coefficients=4 if "sh_degree" in options else 0)
    with pytest.raises((ValueError, TypeError), match=message):
        rasterization(*leaves, **place._asdict(), **options)


def test_wrong_shapes_types_and_devices_are_named():
    leaves, place = scene()
    for index, bad, message in (
        (0, leaves[0][:, :2], r"means has shape \[200, 2\], expected \[N, 3\]"),
        (1, leaves[1].double(), "quats is torch.float64"),
        (3, leaves[3][:, None], "opacities has shape"),
        (5, place[0][0], "viewmats has shape"),
        (6, place[1].half(), "Ks is torch.float16, expected torch.float32 or torch.float64"),
        (6, [[1.0]], "Ks is a builtins.list"),
    ):
        arguments = [*leaves, *place]
        arguments[index] = bad
        with pytest.raises((ValueError, TypeError), match=message):
            rasterization(*arguments)


def test_misfits_of_intersections_are_named():
    fits = {
        "means2d": torch.zeros(2, 5, 2),
        "radii": torch.ones(2, 5, 2, dtype=torch.int32),
        "depths": torch.ones(2, 5),
    }
    for name, value, message in (
        ("depths", torch.ones(5), r"means2d has shape \[2, 5, 2\], expected \[N, 2\]"),
        ("means2d", torch.zeros(2, 5, 3), r"means2d has shape \[2, 5, 3\], expected \[2, N, 2\]"),
        ("radii", torch.ones(2, 5), r"radii has shape \[2, 5\], expected a tensor \[2, 5, 2\]"),
        ("radii", None, "radii is a NoneType"),
        ("depths", [1.0], "depths is a builtins.list"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            gsplat.isect_tiles(**(fits | {name: value}), tile_size=16, tile_width=3, tile_height=2)


def gradients(colors, leaves):
    for leaf in leaves:
        leaf.grad = None
    weights = torch.rand(colors.shape, generator=torch.Generator().manual_seed(3)).to(colors)
    (colors * weights).sum().backward()
    return [leaf.grad.clone() for leaf in leaves]


@pytest.mark.parametrize("options", [{}, {"render_mode": "RGB+ED"}, {"sh_degree": 1}, {"absgrad": True}])
def test_packed_results_are_the_visible_of_the_others(options, device):
    leaves, place = scene(device, coefficients=4 if "sh_degree" in options else 0)
    with torch.no_grad():
        leaves[0][:20, 2] -= 100.0
    results = []
    for packed in (True, False):
        colors, alphas, info = rasterization(*leaves, **place._asdict(), packed=packed, **options)
        info["means2d"].retain_grad()
        results.append((colors, alphas, info, gradients(colors, leaves)))
    (colors, alphas, info, grads), (other_colors, other_alphas, other, expected) = results
    torch.testing.assert_close(colors, other_colors)
    torch.testing.assert_close(alphas, other_alphas)
    for one, two in zip(grads, expected, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-4)
    rows = info["camera_ids"], info["gaussian_ids"]
    assert (info["batch_ids"] == 0).all() and 0 < len(rows[0]) < 2 * COUNT - 40
    assert torch.equal((other["radii"] > 0).all(-1).nonzero(), torch.stack(rows, 1))
    for name in ("radii", "means2d", "depths", "conics", "opacities"):
        torch.testing.assert_close(info[name], other[name][rows])
    torch.testing.assert_close(info["means2d"].grad, other["means2d"].grad[rows], rtol=1e-3, atol=1e-4)
    if "absgrad" in options:
        torch.testing.assert_close(info["means2d"].absgrad, other["means2d"].absgrad[rows], rtol=1e-3, atol=1e-4)


def test_absolute_gradients_are_sums_over_pixels(device):
    """Each pixel differentiated alone; where all of them pull one way they are the gradient."""
    generator = torch.Generator().manual_seed(2)
    leaves, _ = scene(device, count=6)
    leaves = [leaf.detach().double().requires_grad_() for leaf in leaves]
    pose = torch.eye(4, dtype=torch.float64, device=device)[None]
    pose[:, 2, 3] = 3.0
    lens = torch.tensor([[[12.0, 0, 8], [0, 12.0, 6], [0, 0, 1]]], dtype=torch.float64, device=device)
    colors, alphas, info = rasterization(*leaves, pose, lens, 16, 12, packed=False, absgrad=True, render_mode="RGB+D")
    weights = torch.randn(colors.shape, generator=generator, dtype=torch.float64).to(device)
    by_alpha = torch.randn(alphas.shape, generator=generator, dtype=torch.float64).to(device)
    energy = (colors * weights).sum(-1) + (alphas * by_alpha).sum(-1)
    sums = torch.zeros_like(info["means2d"])
    for y in range(12):
        for x in range(16):
            sums += torch.autograd.grad(energy[0, y, x], info["means2d"], retain_graph=True)[0].abs()
    energy.sum().backward()
    assert (sums > 0).any()
    torch.testing.assert_close(info["means2d"].absgrad, sums, rtol=1e-6, atol=1e-9)


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


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
def test_covariances_and_cameras_are_projected_alike(model, device):
    """A pinhole's kernel against torch's operations; other cameras against differences of their formulas."""
    leaves, place = scene(device, count=12)
    leaves = [leaf.detach().double().requires_grad_() for leaf in leaves]
    place = place._replace(viewmats=place.viewmats.double(), Ks=place.Ks.double())
    covars = quat_scale_to_covar_preci(leaves[1], leaves[2])[0]
    options = {"packed": False, "camera_model": model, "rasterize_mode": "classic"}
    colors, _, info = rasterization(*leaves, **place._asdict(), **options)
    same, _, _ = rasterization(leaves[0], None, None, *leaves[3:], **place._asdict(), covars=covars, **options)
    torch.testing.assert_close(colors, same, rtol=1e-6, atol=1e-8)
    for one, two in zip(gradients(colors, leaves), gradients(same, leaves), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-7)
    assert bool((info["radii"] > 0).any())
    few = [leaf.detach()[:3].requires_grad_() for leaf in leaves[:4]]

    def conics(*tensors):
        return fully_fused_projection(
            tensors[0], None, *tensors[1:3], **place._asdict(), camera_model=model, opacities=tensors[3]
        )[1:4]

    assert torch.autograd.gradcheck(conics, few, eps=1e-6, atol=1e-5, rtol=1e-3)


def test_far_planes_and_small_radii_cull(device):
    leaves, place = scene(device)
    _, _, info = rasterization(*leaves, **place._asdict(), packed=False)
    size = info["radii"].amax(-1)
    limit = float(size[size > 0].float().median())
    _, _, clipped = rasterization(*leaves, **place._asdict(), packed=False, radius_clip=limit)
    assert torch.equal((clipped["radii"] > 0).all(-1), (size > limit))
    middle = float(info["depths"][0].median())
    _, _, cut = rasterization(*leaves, **place._asdict(), packed=False, far_plane=middle)
    assert bool((cut["radii"][info["depths"] > middle] == 0).all()) and bool((cut["radii"] > 0).any())


def test_intersections_are_made_when_they_are_read(device):
    leaves, place = scene(device)
    _, _, info = rasterization(*leaves, **place._asdict(), packed=False)
    assert {"isect_ids", "flatten_ids", "isect_offsets", "tiles_per_gauss"} <= set(info)
    counts, offsets, ids = info["tiles_per_gauss"], info["isect_offsets"], info["isect_ids"]
    assert counts.shape == (2, COUNT) and int(counts.sum()) == len(ids) == len(info["flatten_ids"])
    assert (
        offsets.shape == (2, 2, 3) and (ids.diff() >= 0).all() and (info["tile_width"], info["tile_height"]) == (3, 2)
    )
    assert torch.equal((counts > 0), (info["radii"] > 0).all(-1))
    # The second camera's last tile: those whose rectangle reaches there.
    last = info["flatten_ids"][int(offsets[1, 1, 2]) :].long() - COUNT
    corner = info["means2d"][1] + info["radii"][1]
    inside = (corner > torch.tensor([32.0, 16.0], device=device)).all(1) & (counts[1] > 0)
    assert set(last.tolist()) == set(inside.nonzero()[:, 0].tolist())
    assert pickle.loads(pickle.dumps({k: v for k, v in info.items() if k != "means2d"}))["width"] == WIDTH


@pytest.mark.parametrize(
    "read",
    [dict, lambda info: {**info}, lambda info: info.copy(), lambda info: info | {}, lambda info: {} | info],
    ids=["dict", "unpacked", "copy", "or", "or of another"],
)
def test_copies_of_meta_hold_values(read):
    leaves, place = scene()
    _, _, info = rasterization(*leaves, **place._asdict())
    copied = read(info)
    assert list(copied) == list(info)
    assert not any(callable(dict.get(copied, key)) for key in copied)
    assert torch.equal(info.pop("isect_ids"), copied["isect_ids"]) and "isect_ids" not in info
    with pytest.raises(KeyError):
        info.pop("isect_ids")


@pytest.mark.parametrize("options", [{}, {"camera_model": "ortho"}, {"sh_degree": 1}])
def test_inputs_that_are_not_contiguous_give_the_same(options, device):
    leaves, place = scene(device, coefficients=4 if "sh_degree" in options else 0)
    truth, _, _ = rasterization(*leaves, **place._asdict(), **options)
    expected = gradients(truth, leaves)
    strided = [torch.stack([leaf.detach()] * 2, dim=-1)[..., 0].requires_grad_() for leaf in leaves]
    transposed = [tensor.mT.contiguous().mT for tensor in place[:2]]
    assert not any(tensor.is_contiguous() for tensor in (*strided, *transposed))
    colors, _, _ = rasterization(*[*strided, *transposed], WIDTH, HEIGHT, **options)
    assert torch.equal(colors, truth)
    for mine, its in zip(gradients(colors, strided), expected, strict=True):
        torch.testing.assert_close(mine, its)


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
    """As torch's operations do it, by which covariances are projected."""
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


@pytest.mark.parametrize("packed", [False, True])
def test_projections_of_batches_are_those_of_each_scene(packed, device):
    leaves, (viewmats, Ks, width, height) = scene(device=device)
    means, quats, scales, opacities = (leaf.detach() for leaf in leaves[:4])
    shifts = [torch.tensor([0.1 * k, 0.0, 0.0], device=device) for k in range(2)]
    options = {"packed": packed, "calc_compensations": True}
    each = [
        fully_fused_projection(
            means + shift, None, quats, scales, viewmats, Ks, width, height, opacities=opacities, **options
        )
        for shift in shifts
    ]
    pair = [torch.stack([tensor] * 2) for tensor in (quats, scales, viewmats, Ks, opacities)]
    both = fully_fused_projection(
        torch.stack([means + shift for shift in shifts]), None, *pair[:4], width, height, opacities=pair[4], **options
    )
    if packed:
        assert torch.equal(both[0].bincount(), torch.tensor([len(one[0]) for one in each], device=device))
    for mine, *true in zip(both[packed:], *(one[packed:] for one in each), strict=True):
        assert torch.equal(mine, torch.cat(true) if packed else torch.stack(true))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera_model": "ftheta"}, "camera_model 'ftheta' is none of pinhole, ortho, fisheye"),
        ({"sparse_grad": True}, "sparse_grad = True is not supported"),
        ({"quats": None}, r"quats is a builtins.NoneType, expected a torch tensor \[N, 4\]"),
        ({"scales": torch.ones(3, 3)}, r"scales has shape \[3, 3\], expected \[N, 3\]"),
        ({"opacities": torch.ones(3)}, r"opacities has shape \[3\], expected \[N\]"),
    ],
)
def test_misfits_of_a_projection_are_named(options, message):
    (means, quats, scales, *_), place = scene()
    names = "means", "covars", "quats", "scales", "viewmats", "Ks", "width", "height"
    arguments = dict(zip(names, (means, None, quats, scales, *place), strict=True)) | options
    with pytest.raises((ValueError, TypeError), match=message):
        fully_fused_projection(**arguments)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: gsplat.compute_relocation(torch.ones(3), torch.ones(2, 3), torch.ones(3)),
            r"scales has shape \[2, 3\]",
        ),
        (lambda: gsplat.compute_relocation(torch.ones(3), torch.ones(3, 3), torch.ones(2)), r"ratios has shape \[2\]"),
        (lambda: gsplat.spherical_harmonics(1, torch.ones(3, 3), torch.ones(2, 4, 3)), r"coeffs has shape \[2, 4, 3\]"),
        (lambda: gsplat.spherical_harmonics(1, torch.ones(3, 2), torch.ones(3, 4, 3)), r"dirs has shape \[3, 2\]"),
        (lambda: quat_scale_to_covar_preci(torch.ones(3, 4), torch.ones(2, 3)), r"scales has shape \[2, 3\]"),
    ],
)
def test_misfits_of_other_functions_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
