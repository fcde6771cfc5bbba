"""gsplat's projection functions: cameras, covariances, culling, batches and misfits."""

import pytest
import torch

from sehdr_warp.compat import gsplat
from sehdr_warp.compat.gsplat import fully_fused_projection, quat_scale_to_covar_preci, rasterization

from .scenes import gradients, scene


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
    projected = fully_fused_projection(
        leaves[0], covars, leaves[1], 9 * leaves[2], **place._asdict(), camera_model=model, opacities=leaves[3]
    )
    torch.testing.assert_close(projected[3], info["conics"], rtol=1e-6, atol=1e-8)  # Covariances take precedence.
    assert bool((info["radii"] > 0).any())
    few = [leaf.detach()[:3].requires_grad_() for leaf in leaves[:4]]

    def conics(*tensors):
        return fully_fused_projection(
            tensors[0], None, *tensors[1:3], **place._asdict(), camera_model=model, opacities=tensors[3]
        )[1:4]

    assert torch.autograd.gradcheck(conics, few, eps=1e-6, atol=1e-5, rtol=1e-3)


def test_the_upper_triangle_of_covariances_is_read_alone(device):
    """The lower triangle changes nothing and gets no gradient, as in gsplat."""
    leaves, place = scene(device, count=12)
    symmetric = quat_scale_to_covar_preci(leaves[1], leaves[2])[0].detach()
    upper = symmetric.triu().requires_grad_()
    images = [
        rasterization(leaves[0], None, None, *leaves[3:], **place._asdict(), covars=covars)[0]
        for covars in (symmetric, upper)
    ]
    assert torch.equal(*images)
    images[1].square().sum().backward()
    assert bool((upper.grad.triu(1) != 0).any()) and not bool(upper.grad.tril(-1).any())


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_a_negative_near_plane_shows_nothing_behind_the_camera(model, device):
    leaves, place = scene(device, count=12)
    leaves[0].data[:6, 2] = -5.0
    leaves[0].data[6, 2] = -3.0  # At the first camera.
    radii, *_ = fully_fused_projection(
        leaves[0], None, *leaves[1:3], **place._asdict(), near_plane=-9.0, camera_model=model
    )
    covars = quat_scale_to_covar_preci(leaves[1], leaves[2])[0]
    same, means2d, *_ = fully_fused_projection(
        leaves[0], covars, None, None, **place._asdict(), near_plane=-9.0, camera_model=model
    )
    assert not radii[0, :7].any() and not same[0, :7].any() and same[0, 7:].any()
    means2d.sum().backward()
    assert leaves[0].grad.isfinite().all()


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
        ({"covars": torch.tensor(1.0)}, r"covars has shape \[\], expected \[N, 3, 3\]"),
        ({"sparse_grad": True}, "sparse_grad = True is not supported"),
        ({"quats": None}, r"quats is a NoneType, expected a torch tensor \[N, 4\]"),
        ({"scales": torch.ones(3, 3)}, r"scales has shape \[3, 3\], expected \[N, 3\]"),
        ({"opacities": torch.ones(3)}, r"opacities has shape \[3\], expected \[N\]"),
        ({"width": 0}, "width 0 is not in 1.."),
        ({"width": 1 << 16, "height": 1 << 15}, "2\\^31 pixels or more"),
        ({"height": 31.5}, "height is 31.5, expected a whole number"),
        ({"eps2d": -1.0}, "eps2d -1.0 is not a number from 0"),
    ],
)
def test_misfits_of_a_projection_are_named(options, message):
    (means, quats, scales, *_), place = scene()
    names = "means", "covars", "quats", "scales", "viewmats", "Ks", "width", "height"
    arguments = dict(zip(names, (means, None, quats, scales, *place), strict=True)) | options
    with pytest.raises((ValueError, TypeError), match=message):
        fully_fused_projection(**arguments)


def test_misfits_of_intersections_are_named():
    fits = {
        "means2d": torch.zeros(2, 5, 2),
        "radii": torch.ones(2, 5, 2, dtype=torch.int32),
        "depths": torch.ones(2, 5),
    }
    for name, value, message in (
        ("depths", torch.ones(5), r"means2d has shape \[2, 5, 2\], expected \[N, 2\]"),
        ("means2d", torch.zeros(2, 5, 3), r"means2d has shape \[2, 5, 3\], expected \[2, N, 2\]"),
        ("radii", torch.ones(2, 5), r"radii has shape \[2, 5\], expected \[2, 5, 2\]"),
        ("radii", None, "radii is a NoneType"),
        ("depths", [1.0], "depths is a list"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            gsplat.isect_tiles(**(fits | {name: value}), tile_size=16, tile_width=3, tile_height=2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: gsplat.compute_relocation(torch.ones(3), torch.ones(2, 3), torch.ones(3)),
            r"scales has shape \[2, 3\]",
        ),
        (lambda: gsplat.compute_relocation(torch.ones(3), torch.ones(3, 3), torch.ones(2)), r"ratios has shape \[2\]"),
        (lambda: quat_scale_to_covar_preci(torch.ones(3, 4), torch.ones(2, 3)), r"scales has shape \[2, 3\]"),
        (lambda: gsplat.compute_relocation(torch.ones(3), torch.ones(3, 3), [1] * 3), "ratios is a list"),
        (
            lambda: torch.func.grad(lambda means: fully_fused_projection(means, *(None,) * 5, 4, 3))(torch.ones(3, 3)),
            r"fully_fused_projection\(\) does not support torch\.func",
        ),
    ],
)
def test_misfits_of_other_functions_are_named(call, message):
    with pytest.raises((ValueError, TypeError, NotImplementedError), match=message):
        call()
