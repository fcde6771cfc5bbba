"""Projected Gaussians and their gradients against torch in float64."""

import math

import pytest
import torch

from sehdr_warp.kernels.project import projection_kernel
from sehdr_warp.rasterizer.projection import launch_projection, project_to_camera, projection_parameters
from sehdr_warp.rasterizer.reference import project_reference
from sehdr_warp.rasterizer.render_options import RenderOptions
from sehdr_warp.rasterizer.warp_launch.launching import warp_scalar

from ..rasterizer.scenes import finite_differences, random_like, random_scene, relative_error

NAMES = "means", "log_scales", "quaternions", "opacities", "world_to_camera", "intrinsics"
RESULTS = "means2d", "conics", "depths", "opacities", "extents"
OPTIONS = RenderOptions(70, 50, 0.01, 0.3, 1 / 255)


def inputs(**options):
    scene = random_scene(**options)
    return [*scene.tensors[:4], *scene.tensors[5:]]


def total(results, visible):
    return sum((part[visible] * random_like(part, k)[visible]).sum() for k, part in enumerate(results[:4]))


@pytest.mark.parametrize("antialiased", [False, True], ids=["plain", "antialiased"])
@pytest.mark.parametrize("limits", [(math.inf, math.inf), (0.3, 0.1)], ids=["of the image", "narrower"])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-11), (torch.float32, 1e-4)])
def test_values_and_gradients_are_the_references(device, dtype, bound, limits, antialiased):
    leaves = [tensor.requires_grad_() for tensor in inputs()]
    ours = [tensor.detach().to(device, dtype).requires_grad_() for tensor in leaves]
    x, y = limits
    options = OPTIONS._replace(antialiased=antialiased, ray_limit_x=x, ray_limit_y=y)
    width, height, near_plane, eps2d, threshold = options[:5]
    truth = project_reference(*leaves, width, height, near_plane, eps2d, threshold, antialiased, x, y)
    results = project_to_camera(*ours, options)
    visible = truth[4][:, 0] > 0
    assert 30 < visible.sum() < 120 and torch.equal(results.extents.cpu()[:, 0] > 0, visible)
    for name, mine, true in zip(RESULTS, results, truth, strict=True):
        assert relative_error(mine[visible.to(device)], true[visible]) < bound / 10, name
    assert not results.opacities[~visible.to(device)].any()
    total(truth, visible).backward()
    total(results, visible.to(device)).backward()
    for name, mine, true in zip(NAMES, ours, leaves, strict=True):
        assert relative_error(mine.grad, true.grad) < bound, name


@pytest.mark.parametrize("length", [1e-18, 1e-12, 1e12, 1e18])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_quaternions_of_any_length_turn_alike(device, dtype, bound, length):
    results = []
    for factor in (1.0, length):
        tensors = inputs(count=20)
        tensors[2] = (factor * tensors[2]).detach()
        leaves = [tensor.to(device, dtype).requires_grad_() for tensor in tensors]
        conics = project_to_camera(*leaves, OPTIONS).conics
        (conics * random_like(conics, 1)).sum().backward()
        results.append((conics, factor * leaves[2].grad.double()))
    for ours, truth in zip(*results[::-1], strict=True):
        assert relative_error(ours, truth) < bound and truth.any()


def test_gaussians_with_cameras_of_their_own_are_projected_each_by_its_own(device):
    *gaussians, pose, intrinsics = (tensor.to(device) for tensor in inputs(count=6, spread=0.5))
    poses, lenses = pose.repeat(6, 1, 1), torch.linspace(1, 2, 6, device=device)[:, None] * intrinsics
    poses[:, 2, 3] += torch.arange(6, device=device) + 3.0
    leaves = [tensor.detach().requires_grad_() for tensor in (*gaussians, poses, lenses)]
    kernel = projection_kernel(warp_scalar(torch.float64), False, False, True)
    outputs = [torch.empty(6, *shape, dtype=torch.float64, device=device) for shape in ((2,), (3,), (), (), (2,))]
    ours = launch_projection(kernel, leaves, projection_parameters(OPTIONS), outputs)
    each = [
        project_to_camera(*(leaf[i : i + 1] for leaf in leaves[:4]), poses[i], lenses[i], OPTIONS) for i in range(6)
    ]
    for mine, *others in zip(ours, *each, strict=True):
        torch.testing.assert_close(mine, torch.cat(others), rtol=1e-12, atol=0)
    visible = ours[4][:, 0] > 0
    assert visible.sum() > 3
    for gradient in torch.autograd.grad(total(ours, visible), leaves[4:]):
        assert torch.equal(gradient.flatten(1).any(1), visible)


@pytest.mark.parametrize("which", [1, 2], ids=["log_scales", "quaternions"])
def test_the_compensation_is_differentiated_where_asked(device, which):
    tensors = inputs(count=8, spread=1.0)
    tensors[0][:, 2] = tensors[0][:, 2].abs() + 2.0
    options = OPTIONS._replace(antialiased=True, alpha_threshold=1e-9)

    def opacities(*leaves, **options_of_gradient):
        projected = project_to_camera(*(leaf.to(device) for leaf in leaves), options, **options_of_gradient)
        return (projected.opacities * random_like(projected.opacities, 1)).sum()

    leaves = [tensor.requires_grad_() for tensor in tensors]
    opacities(*leaves, differentiate_compensation=True).backward()
    numeric = finite_differences(opacities, leaves, which)
    # Its root has a slope that is held finite by a millionth.
    assert relative_error(leaves[which].grad, numeric) < 1e-4
    leaves[which].grad = None
    opacities(*leaves).backward()
    assert not leaves[which].grad.any()


# Behind the camera, on its plane, at numbers that float32 cannot square, without a size, and not finite.
EXTREMES = [
    (0, (0.0, 0.0, -1.0)), (0, (0.0, 0.0, 0.0)), (0, (0.0, 0.0, 1e30)), (0, (1e30, 0.0, 1.0)), (1, (-1e30,) * 3),
    (1, (1e30,) * 3), (0, (math.nan, 0.0, 2.0)), (1, (math.inf, 0.0, 0.0)), (2, (math.nan, 0.0, 0.0, 0.0)),
    (2, (1e-30, 0.0, 0.0, 0.0)), (2, (1e30, 0.0, 0.0, 0.0)), (3, 0.0), (3, math.nan),
]  # fmt: skip


@pytest.mark.parametrize(("place", "value"), EXTREMES)
@pytest.mark.parametrize("antialiased", [False, True], ids=["plain", "antialiased"])
def test_extreme_gaussians_are_culled_or_numbers(device, place, value, antialiased):
    tensors = [tensor.to(device, torch.float32) for tensor in inputs(count=3, spread=0.5)]
    tensors[0][:, 2] += 3.0
    tensors[place][1] = torch.tensor(value)
    leaves = [tensor.requires_grad_() for tensor in tensors]
    results = project_to_camera(*leaves, OPTIONS._replace(antialiased=antialiased))
    sum(part.sum() for part in results[:4]).backward()
    assert all(part.isfinite().all() for part in results) and all(leaf.grad.isfinite().all() for leaf in leaves)
    assert (results.extents[::2] > 0).all() and (results.extents >= 0).all()
    assert bool(results.extents[1].any()) or not any(leaf.grad[1].any() for leaf in leaves[:4])


def test_nothing_is_projected_to_nothing(device):
    leaves = [tensor.to(device).requires_grad_() for tensor in inputs(count=0)]
    sum(part.sum() for part in project_to_camera(*leaves, OPTIONS)[:4]).backward()
    assert not any(leaf.grad.any() for leaf in leaves)
