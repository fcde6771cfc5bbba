"""The whole splat against its plain torch reference and against finite differences, on every device."""

import math
import weakref

import pytest
import torch

from sehdr_warp.rasterizer import projection, rasterize
from sehdr_warp.rasterizer.reference import rasterize_reference

from .scenes import finite_differences, random_like, random_scene, relative_error

NAMES = ("means", "log_scales", "quaternions", "opacities", "features", "world_to_camera", "intrinsics")
BOUNDS = {torch.float64: (1e-12, 1e-11), torch.float32: (1e-5, 1e-4)}  # Largest relative error in norm: value, gradient


def backward(rendering):
    """A loss that weighs every pixel of image and alpha differently."""
    loss = (rendering.image * random_like(rendering.image, 3)).sum()
    loss = loss + (rendering.alpha * random_like(rendering.alpha, 4)).sum()
    loss.backward()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("channels", [1, 3, 9])
@pytest.mark.parametrize("option", ["plain", "antialiased", "order_axis"])
def test_matches_the_reference(device, dtype, channels, option):
    if option != "plain" and channels != 3:
        pytest.skip("other options do not look at the channels")
    scene, axis = random_scene(channels=channels), torch.tensor([0.6, -0.5, 0.8], dtype=dtype)
    ours, truth = scene.to(dtype, device), scene.to(torch.float64)
    mine, true = {"antialiased": [True] * 2, "order_axis": [axis.to(device), axis.double()]}.get(option, [None] * 2)
    rendering = rasterize(*ours.arguments, **({option: mine} if option != "plain" else {}))
    reference = rasterize_reference(*truth.arguments, **({option: true} if option != "plain" else {}))
    value_bound, gradient_bound = BOUNDS[dtype]
    assert relative_error(rendering.image, reference.image) < value_bound
    assert relative_error(rendering.alpha, reference.alpha) < value_bound
    assert torch.equal(rendering.visible.cpu(), reference.visible)
    backward(rendering)
    backward(reference)
    for name, tensor, true in zip(NAMES, ours.tensors, truth.tensors):
        assert relative_error(tensor.grad, true.grad) < gradient_bound, name


@pytest.mark.parametrize("cameras", [1, 2])
def test_gaussians_are_ordered_along_any_axis(device, cameras):
    """The left Gaussian is in front along the camera's axis, the right one along an axis to the left."""
    means = torch.tensor([[-0.05, 0.0, 4.0], [0.05, 0.0, 4.01]], device=device)
    log_scales, quaternions = torch.full((2, 3), -1.0, device=device), torch.eye(4, device=device)[[0, 0]]
    opacities, features = torch.full((2,), 0.9, device=device), torch.eye(2, device=device)
    pose, pinhole = torch.eye(4, device=device), torch.tensor([40.0, 40.0, 20.0, 15.0], device=device)
    if cameras > 1:
        pose, pinhole = pose.expand(cameras, 4, 4), pinhole.expand(cameras, 4)

    def weights(*axis):
        options = {"order_axis": torch.tensor(axis, device=device)} if axis else {}
        rendering = rasterize(
            means, log_scales, quaternions, opacities, features, pose, pinhole, 40, 30, depth=True, **options
        )
        mean_depth = rendering.depth[..., 15, 20] / rendering.alpha[..., 15, 20]
        assert torch.allclose(rendering.depths, means[:, 2]) and 3.999 < float(mean_depth.min()) < 4.011
        return rendering.image[..., 15, 20, :].reshape(cameras, 2)[-1].tolist()

    assert weights() == weights(0.0, 0.0, 1.0) == weights(0.0, 0.9, 1.0)
    assert weights()[0] > 5 * weights()[1]
    first, second = weights(-0.3, 0.0, 1.0)
    assert second > 5 * first
    for length in (1e-5, 2.0**-80, 2.0**100):
        assert weights(-0.3 * length, 0.0, length) == pytest.approx([first, second], rel=1e-5)
    assert weights(1e30, 0.0, 0.0)[0] > 0.5  # Both at least at a thousandth of their depth


def test_transmittance_keeps_its_digits_where_little_is_left(device):
    scene = random_scene(count=600, channels=1, width=44, height=26, spread=1.6, seed=2).to(torch.float32, device)
    with torch.no_grad():
        ours = rasterize(*scene.arguments)
        truth = rasterize_reference(*scene.to(torch.float64).arguments).transmittance
    faint = truth < 1e-3
    assert faint.sum() > 500
    # 1 - alpha would be wrong by 8e-5 here.
    assert relative_error(ours.transmittance[faint], truth[faint]) < 3e-5
    assert torch.equal(ours.alpha, 1 - ours.transmittance)


@pytest.mark.parametrize("which", range(len(NAMES)), ids=NAMES)
def test_gradients_match_finite_differences(device, which):
    # Few, wide Gaussians and a tiny threshold keep every pixel away from the cut-offs, where no derivative exists.
    scene = random_scene(count=12, channels=2, width=18, height=17, spread=0.8, size=0.6, seed=1)
    scene.tensors[0] = scene.tensors[0].clone()
    scene.tensors[0][:, 2] = scene.tensors[0][:, 2].abs() * 0.3 + 2.0
    scene.tensors[3] = scene.tensors[3] * 0.4

    def loss(*tensors, dtype=torch.float64):
        moved = [t.to(device=device, dtype=dtype) for t in tensors]
        rendering = rasterize(*moved, scene.width, scene.height, alpha_threshold=1e-12)
        return (rendering.image * random_like(rendering.image, 5)).sum() + rendering.alpha.square().sum()

    numeric = finite_differences(loss, scene.tensors, which)
    for dtype, bound in ((torch.float64, 1e-8), (torch.float32, 1e-4)):
        tensors = [t.detach().clone().requires_grad_() for t in scene.tensors]
        loss(*tensors, dtype=dtype).backward()
        assert relative_error(tensors[which].grad, numeric) < bound


def test_cpu_results_do_not_depend_on_the_number_of_threads(monkeypatch):
    results = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("SEHDR_THREADS", threads)
        scene = random_scene(count=300).to(torch.float32)
        rendering = rasterize(*scene.arguments)
        backward(rendering)
        results.append([rendering.image, rendering.alpha, *(t.grad for t in scene.tensors)])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_means2d_carries_the_densification_signal(device):
    scene = random_scene().to(torch.float32, device)
    rendering = rasterize(*scene.arguments)
    rendering.means2d.retain_grad()
    backward(rendering)
    gradient = rendering.means2d.grad
    assert gradient.shape == (150, 2)
    assert (gradient[rendering.visible].abs().sum(1) > 0).any()
    assert (gradient[~rendering.visible] == 0).all()


def test_tensors_that_need_no_gradient_get_none(device):
    scene = random_scene().to(torch.float32, device)
    for tensor in scene.tensors[:4] + scene.tensors[5:]:
        tensor.requires_grad_(False)
    rasterize(*scene.arguments).image.sum().backward()
    assert scene.tensors[4].grad is not None
    assert all(tensor.grad is None for tensor in scene.tensors[:4])
    with torch.no_grad():
        assert not rasterize(*scene.arguments).image.requires_grad


def test_gaussians_that_a_capacity_leaves_out_get_no_gradient(device):
    scene = random_scene().to(torch.float32, device)
    rendering = rasterize(*scene.arguments, max_intersections=1)
    backward(rendering)
    assert rendering.overflow
    assert int((scene.tensors[4].grad != 0).any(1).sum()) == 1
    assert int((scene.tensors[0].grad != 0).any(1).sum()) == 1


def test_a_capacity_changes_nothing_when_it_is_enough_and_says_so_when_not(device):
    scene = random_scene().to(torch.float32, device)
    exact = rasterize(*scene.arguments)
    roomy = rasterize(*scene.arguments, max_intersections=exact.intersection_count + 100)
    assert exact.overflow is None and not roomy.overflow
    assert torch.equal(exact.image, roomy.image)
    cramped = rasterize(*scene.arguments, max_intersections=exact.intersection_count - 1)
    assert cramped.overflow
    for rendering in (roomy, cramped):
        rendering.image.sum().backward()
        assert all(torch.isfinite(t.grad).all() for t in scene.tensors)


def test_many_faint_gaussians_keep_their_gradients(device):
    """10^4 factors of 1 - 1e-4 lost three digits of every gradient while the adjoint divided by them one by one."""
    scene = random_scene(count=10_000, channels=1, width=3, height=2, spread=0.1)
    scene.tensors[1][:] = 0.0
    scene.tensors[3][:] = 1e-4
    scene.tensors[0][:, 2] = torch.linspace(2.0, 6.0, 10_000, dtype=torch.float64)
    ours, truth = scene.to(torch.float32, device), scene.to(torch.float32).to(torch.float64)
    rasterize(*ours.arguments, alpha_threshold=1e-6).image.sum().backward()
    rasterize_reference(*truth.arguments, alpha_threshold=1e-6).image.sum().backward()
    for which in (3, 4):
        assert relative_error(ours.tensors[which].grad, truth.tensors[which].grad) < 2e-5


def test_deterministic_gradients_repeat_bit_for_bit_and_are_the_others(device):
    scene = random_scene(count=3000, channels=5, width=120, height=70, spread=2.0, seed=3).to(torch.float32, device)

    def render(deterministic=True, max_intersections=None):
        for tensor in scene.tensors:
            tensor.grad = None
        rendering = rasterize(*scene.arguments, deterministic=deterministic, max_intersections=max_intersections)
        backward(rendering)
        return [rendering.image, *(tensor.grad for tensor in scene.tensors)]

    first = render()
    for again in (render(), render(), render(max_intersections=100_000)):
        assert all(torch.equal(a, b) for a, b in zip(first, again))
    for ours, other in zip(first, render(deterministic=False)):
        assert relative_error(ours, other) < 1e-5


ALL = tuple(range(len(NAMES)))


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize(
    "count, required, antialiased",
    [(150, ALL, False), (150, ALL, True), (150, (0, 5), False), (150, (6,), False), (1, ALL, False), (0, ALL, False)],
)
def test_summed_gradients_of_each_gaussians_own_camera_are_the_reference(
    device, count, required, antialiased, deterministic, monkeypatch
):
    rows, zero_gradients = [], projection.zero_gradients

    def watch(tensors, needed):
        gradients = zero_gradients(tensors, needed)
        rows[:] = [None if each is None else (each.shape, weakref.ref(each)) for each in gradients[4:]]
        return gradients

    monkeypatch.setattr(projection, "adds_in_any_order", lambda device: True)
    monkeypatch.setattr(projection, "zero_gradients", watch)
    ours, truth = [random_scene(count, seed=5).to(torch.float64, place) for place in (device, None)]
    for scene in (ours, truth):
        for place, tensor in enumerate(scene.tensors):
            tensor.requires_grad_(place in required)
    backward(rasterize(*ours.arguments, antialiased=antialiased, deterministic=deterministic))
    backward(rasterize_reference(*truth.arguments, antialiased=antialiased))
    shapes = [(count, 4, 4) if 5 in required else None, (count, 4) if 6 in required else None]
    assert [row and row[0] for row in rows] == shapes
    assert not any(row and row[1]() is not None for row in rows)  # Their memory is free again.
    for place in required:
        mine, true = ours.tensors[place].grad, truth.tensors[place].grad
        assert mine.shape == true.shape and bool(true.any()) == (count > 0)
        assert relative_error(mine, true) < 1e-11, NAMES[place]


@pytest.mark.parametrize("deterministic", [False, True])
def test_without_gradients_of_the_camera_all_gaussians_share_one(device, deterministic, monkeypatch):
    kernels, projection_kernel = [], projection.projection_kernel

    def watch(*kind):
        kernels.append(kind[-1])
        return projection_kernel(*kind)

    monkeypatch.setattr(projection, "adds_in_any_order", lambda device: True)
    monkeypatch.setattr(projection, "projection_kernel", watch)
    scene = random_scene().to(torch.float64, device)  # Which no CUDA graph replays.
    with torch.no_grad():
        rasterize(*scene.arguments, deterministic=deterministic)
    for tensor in scene.tensors[5:]:
        tensor.requires_grad_(False)
    backward(rasterize(*scene.arguments, deterministic=deterministic))
    assert kernels == [False, False]
    rasterize(*scene.tensors[:5], scene.tensors[5], scene.tensors[6].requires_grad_(), scene.width, scene.height)
    assert kernels == [False, False, True]


def test_a_rendering_prints_in_one_line():
    scene = random_scene(count=5, channels=3)
    assert repr(rasterize(*scene.arguments)) == "Rendering(70 x 50, 3 channels, 5 Gaussians, on cpu)"


def splat(device, means, sigma, opacity, features, width, height, focal=None):
    """Round Gaussians of standard deviation `sigma` [N] before a camera at the origin: rendering and its leaves."""
    count = len(means)
    leaves = [
        torch.as_tensor(means, dtype=torch.float32),
        torch.as_tensor(sigma, dtype=torch.float32).log().reshape(-1, 1).expand(count, 3),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.as_tensor(opacity, dtype=torch.float32).expand(count),
        torch.as_tensor(features, dtype=torch.float32),
    ]
    leaves = [leaf.to(device).clone().requires_grad_() for leaf in leaves]
    focal = focal or float(width)
    camera = torch.tensor([focal, focal, width / 2, height / 2], device=device)
    return lambda **options: rasterize(*leaves, torch.eye(4, device=device), camera, width, height, **options), leaves


def finite_gradients(rendering, leaves) -> bool:
    (rendering.image.sum() + rendering.alpha.sum()).backward()
    return all(torch.isfinite(leaf.grad).all() for leaf in leaves)


@pytest.mark.parametrize("count", [0, 3])
@pytest.mark.parametrize("size", [(1, 1), (640, 480)])
def test_nothing_to_draw_on_any_image(device, count, size):
    means = torch.tensor([[0.0, 0.0, -3.0]]).repeat(count, 1)
    draw, leaves = splat(device, means, torch.ones(count), 0.5, torch.ones(count, 3), *size)
    for options in ({}, {"max_intersections": 1}):
        rendering = draw(**options)
        assert rendering.image.shape == (size[1], size[0], 3)
        assert not rendering.image.any() and not rendering.alpha.any() and not rendering.visible.any()
        assert finite_gradients(rendering, leaves)


def test_a_single_pixel(device):
    draw, leaves = splat(device, [[0.0, 0.0, 2.0]], [0.5], 0.5, [[3.0]], 1, 1)
    rendering = draw()
    # The center falls on the pixel's own: alpha is the opacity.
    assert rendering.image.item() == pytest.approx(1.5, rel=1e-5)
    assert finite_gradients(rendering, leaves)


def test_one_gaussian_over_a_whole_8k_image(device):
    """7680 x 4320 (an eighth of its height on the CPU), every tile of it: one entry a tile."""
    width, height = 7680, 4320 if device.startswith("cuda") else 540
    draw, leaves = splat(device, [[0.0, 0.0, 1.0]], [40.0], 0.25, [[2.0]], width, height)
    rendering = draw()
    assert rendering.intersection_count == math.ceil(width / 16) * math.ceil(height / 16)
    assert float((rendering.image - 0.5).abs().max().detach()) < 1e-3
    assert finite_gradients(rendering, leaves)
    # d image / d opacity is the feature times the falloff, and d alpha / d opacity the falloff itself.
    assert float(leaves[3].grad) == pytest.approx(3.0 * width * height, rel=1e-3)


def test_very_many_gaussians_in_one_tile(device):
    """All in one tile: as many intersections as Gaussians, the front ones hide the rest."""
    count = 1_000_000 if device.startswith("cuda") else 300_000  # More than one sort takes
    generator = torch.Generator().manual_seed(0)
    depth = 2.0 + torch.arange(count) / count
    spread = (torch.rand(count, 2, generator=generator) - 0.5) * 16 / 64 * depth[:, None]
    means = torch.cat([spread, depth[:, None]], dim=1)[torch.randperm(count, generator=generator)]
    draw, leaves = splat(device, means, torch.full((count,), 0.02), 0.5, means[:, 2:], 16, 16, focal=64.0)
    rendering = draw()
    assert rendering.intersection_count == count
    assert float(rendering.alpha.detach().min()) > 0.99
    assert float((rendering.image[..., 0] / rendering.alpha).detach().max()) < 2.01  # the nearest of depths 2 to 3
    assert finite_gradients(rendering, leaves)
    counted = leaves[4].grad[:, 0] > 0
    assert 0 < int(counted.sum()) < count // 100


def test_a_capacity_too_small_for_one_big_splat(device):
    draw, leaves = splat(device, [[0.0, 0.0, 1.0]], [40.0], 0.5, [[1.0]], 320, 160)
    rendering = draw(max_intersections=7)
    assert rendering.overflow and rendering.intersection_count == 7
    covered = (rendering.alpha > 0).sum()
    assert int(covered) == 7 * 256
    assert finite_gradients(rendering, leaves)
