"""rasterize_directions against sums in NumPy, perspective views, and itself turned round."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sehdr_warp.kernels.constants import ALPHA_MAX, ALPHA_THRESHOLD, EPS2D
from sehdr_warp.kernels.sphere import projection_kernel
from sehdr_warp.rasterizer import rasterize, rasterize_directions
from sehdr_warp.rasterizer.projection import launch_projection
from sehdr_warp.rasterizer.warp_launch.launching import warp_scalar

from ..rasterizer.scenes import finite_differences, random_like, relative_error

FOCAL = 60.0


def gaussians(count=300, seed=0, dtype=torch.float64, device="cpu", size=-2.0):
    """All around the origin, elongated, of all opacities: means, log_scales, quaternions, opacities, features."""
    random = np.random.default_rng(seed)
    means = random.normal(size=(count, 3))
    means *= random.uniform(2, 5, (count, 1)) / np.linalg.norm(means, axis=1, keepdims=True)
    parts = means, size + 0.7 * random.normal(size=(count, 3)), random.normal(size=(count, 4))
    parts = *parts, random.uniform(0.05, 1, count), random.uniform(0, 3, (count, 4))
    return [torch.tensor(part, dtype=dtype, device=device) for part in parts]


def latlong(size=64, dtype=torch.float64, device="cpu"):
    longitude = np.pi - 2 * np.pi * (np.arange(size) + 0.5) / size
    latitude = (np.pi / 2 - np.pi * (np.arange(size // 2) + 0.5) / (size // 2))[:, None] + 0 * longitude
    across = np.cos(latitude)
    grid = np.stack([across * np.sin(longitude), np.sin(latitude), across * np.cos(longitude)], 2)
    return torch.tensor(grid, dtype=dtype, device=device)


def reference(means, log_scales, quaternions, opacities, features, directions, antialiased, pixel_angle, views=None):
    """Every Gaussian at every pixel, in the plane that touches the sphere at its direction."""
    axes = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix() * np.exp(log_scales)[:, None]
    covariances = axes @ axes.swapaxes(1, 2)
    distances = np.linalg.norm(means, axis=1)
    footprint = EPS2D / FOCAL**2
    eps2d = max(footprint, EPS2D * pixel_angle**2)
    image, left = np.zeros((*directions.shape[:2], features.shape[1])), np.ones(directions.shape[:2])
    depths = distances if views is None else np.maximum((means @ views.T).max(1), 0)
    for i in np.argsort(depths, kind="stable"):
        n = means[i] / distances[i]
        tangent = np.linalg.svd(n[None])[2][1:]
        bare = tangent @ covariances[i] @ tangent.T / distances[i] ** 2
        trained, blurred = bare + footprint * np.eye(2), bare + eps2d * np.eye(2)
        before = bare if antialiased else trained
        opacity = opacities[i] * np.sqrt(np.linalg.det(before) / np.linalg.det(blurred))
        forward = directions @ n
        place = (directions @ tangent.T) / np.where(forward > 0, forward, 1)[..., None]
        power = np.einsum("hwi,ij,hwj->hw", place, np.linalg.inv(blurred), place)
        alpha = np.where(forward > 0, np.minimum(opacity * np.exp(-power / 2), ALPHA_MAX), 0)
        alpha = np.where(alpha > ALPHA_THRESHOLD, alpha, 0)
        image += (left * alpha)[..., None] * features[i]
        left *= 1 - alpha
    return image, left


@pytest.mark.parametrize("antialiased, pixel_angle", [(False, 0.0), (False, 0.1), (True, 0.1)])
def test_agrees_with_sums_in_numpy(device, antialiased, pixel_angle):
    scene, directions = gaussians(device=device), latlong(device=device)
    options = {"focal_length": FOCAL, "pixel_angle": pixel_angle, "antialiased": antialiased}
    position = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64, device=device)
    image, left = rasterize_directions(*scene, position, directions, **options)
    arrays = [tensor.cpu().numpy() for tensor in scene]
    arrays[0] = arrays[0] - position.cpu().numpy()
    expected = reference(*arrays, directions.cpu().numpy(), antialiased, pixel_angle)
    # A pixel ends before its transmittance falls below 1e-4.
    np.testing.assert_allclose(left.cpu(), expected[1], atol=2e-4)
    np.testing.assert_allclose(image.cpu(), expected[0], atol=1e-3)
    assert 0.05 < float(left.mean()) < 0.95
    floats = [tensor.float() for tensor in (*scene, position, directions)]
    image32, _ = rasterize_directions(*floats, **options)
    np.testing.assert_allclose(image32.cpu(), image.cpu(), atol=2e-3)


@pytest.mark.parametrize("count", [1, 6, 20])
def test_order_is_that_of_depths_along_the_nearest_axis(device, count):
    scene, directions = gaussians(device=device, size=-1.0), latlong(device=device)
    axes = np.concatenate([np.eye(3), -np.eye(3), Rotation.random(14, rng=0).as_matrix()[:, 2]])[:count]
    axes = torch.tensor(axes, device=device)
    position = torch.zeros(3, dtype=torch.float64, device=device)
    image, _ = rasterize_directions(*scene, position, directions, focal_length=FOCAL, axes=axes)
    arrays = [tensor.cpu().numpy() for tensor in (*scene, directions)]
    np.testing.assert_allclose(image.cpu(), reference(*arrays, False, 0.0, axes.cpu().numpy())[0], atol=1e-3)
    by_distance, _ = rasterize_directions(*scene, position, directions, focal_length=FOCAL)
    assert float((image - by_distance).abs().max()) > 0.1


def test_a_turned_scene_seen_in_turned_directions_is_the_same(device):
    """No direction is special: neither where a map wraps, nor its poles."""
    scene, directions = gaussians(device=device), latlong(device=device)
    position = torch.zeros(3, dtype=torch.float64, device=device)
    image, _ = rasterize_directions(*scene, position, directions, focal_length=FOCAL)
    for turn in (Rotation.from_rotvec([0, np.pi, 0]), Rotation.from_rotvec([np.pi / 2, 0, 0]), Rotation.random(rng=1)):
        matrix = torch.tensor(turn.as_matrix(), device=device)
        quaternions = turn * Rotation.from_quat(np.roll(scene[2].cpu().numpy(), -1, axis=1))
        turned = torch.tensor(np.roll(quaternions.as_quat(), 1, axis=1), device=device)
        moved = [scene[0] @ matrix.T, scene[1], turned, *scene[3:]]
        again, _ = rasterize_directions(*moved, position, directions @ matrix.T, focal_length=FOCAL)
        # Where alpha is its threshold to the last digit, one counts and the other does not.
        torch.testing.assert_close(again, image, atol=2 * 3 * ALPHA_THRESHOLD, rtol=0)
        assert float((again - image).abs().mean()) < 1e-8


def test_agrees_with_perspective_views(device):
    """Small Gaussians, whose perspective is nearly affine, without the footprint of pixels, which differs."""
    scene = gaussians(2000, dtype=torch.float32, device=device, size=-3.6)
    side = 64
    place = 2 * (np.arange(side) + 0.5) / side - 1
    rays = np.stack([*np.meshgrid(place, place), np.ones((side, side))], 2)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    lens = torch.tensor([side / 2, side / 2, side / 2, side / 2], dtype=torch.float32, device=device)
    for turn in (Rotation.identity(), Rotation.from_euler("y", 180, True), Rotation.from_euler("x", 90, True)):
        pose = torch.eye(4, device=device)
        pose[:3, :3] = torch.tensor(turn.as_matrix())
        directions = torch.tensor(rays @ turn.as_matrix(), dtype=torch.float32, device=device)
        flat = rasterize(*scene, pose, lens, side, side, eps2d=1e-6)
        image, _ = rasterize_directions(*scene, torch.zeros(3, device=device), directions, focal_length=1e6)
        assert float((image - flat.image).abs().mean()) < 0.05 * float(flat.image.mean())


NAMES = ("means", "log_scales", "quaternions", "opacities", "features", "position")


@pytest.mark.parametrize("antialiased", [False, True], ids=["plain", "antialiased"])
@pytest.mark.parametrize("which", range(len(NAMES)), ids=NAMES)
def test_gradients_match_finite_differences(device, which, antialiased):
    """A map of several tiles; wide Gaussians of low opacity and a tiny threshold keep pixels from cut-offs."""
    tensors = [*gaussians(12, size=-0.7), torch.tensor([0.1, -0.2, 0.15], dtype=torch.float64)]
    tensors[3] = tensors[3] * 0.3
    options = {"focal_length": FOCAL, "pixel_angle": 0.2, "antialiased": antialiased, "alpha_threshold": 1e-7}

    def loss(*tensors, dtype=torch.float64):
        moved = [tensor.to(device=device, dtype=dtype) for tensor in tensors]
        image, left = rasterize_directions(*moved, latlong(40, dtype, device), **options)
        return (image * random_like(image, 5)).sum() + left.square().sum()

    numeric = finite_differences(loss, tensors, which)
    for dtype, bound in ((torch.float64, 1e-6), (torch.float32, 1e-4)):
        leaves = [tensor.clone().requires_grad_() for tensor in tensors]
        loss(*leaves, dtype=dtype).backward()
        assert relative_error(leaves[which].grad, numeric) < bound


def test_gaussians_with_positions_of_their_own_are_projected_each_from_its_own(device):
    *shapes, _ = gaussians(6, device=device)
    positions = torch.linspace(-0.5, 0.5, 18, dtype=torch.float64, device=device).view(6, 3).requires_grad_()
    kernels = [projection_kernel(warp_scalar(torch.float64), False, own) for own in (True, False)]

    def project(kernel, *inputs):
        outputs = [inputs[0].new_empty(len(inputs[0]), *shape) for shape in ((4,), (3,), (3,), (), ())]
        return launch_projection(kernel, inputs, (0.01, 1e-4, 0.0, ALPHA_THRESHOLD), outputs)

    ours = project(kernels[0], *shapes, positions)
    each = [project(kernels[1], *(part[i : i + 1] for part in shapes), positions[i].detach()) for i in range(6)]
    for mine, *others in zip(ours, *each, strict=True):
        torch.testing.assert_close(mine, torch.cat(others), rtol=1e-12, atol=0)
    [gradient] = torch.autograd.grad(sum((part * random_like(part, 1)).sum() for part in ours[:4]), positions)
    assert gradient.any(1).all()


def gradients(scene, directions, **options):
    leaves = [tensor.clone().requires_grad_() for tensor in scene]
    image, left = rasterize_directions(*leaves, directions, focal_length=FOCAL, **options)
    (image.square().sum() + left.sum()).backward()
    return [leaf.grad for leaf in leaves]


def test_gradients_of_many_hold_in_float32_and_over_threads(device, monkeypatch):
    scene = [*gaussians(2000, device=device), torch.zeros(3, dtype=torch.float64, device=device)]
    truth = gradients(scene, latlong(96, device=device))
    floats, directions = [tensor.float() for tensor in scene], latlong(96, torch.float32, device)
    calls = []
    for threads in ("1", "3"):
        monkeypatch.setenv("SEHDR_THREADS", threads)
        calls.append(gradients(floats, directions))
    for name, one, other, expected in zip(NAMES, *calls, truth, strict=True):
        assert relative_error(one, expected) < 1e-3, name
        assert device != "cpu" or torch.equal(one, other), name


def test_gradients_are_finite_where_nothing_has_a_slope(device):
    """Balls, a point at the viewer, one of no size, and one that is not finite beside others."""
    scene = [*gaussians(6, dtype=torch.float32, device=device), torch.zeros(3, device=device)]
    scene[0][0] = 0
    scene[1][:3] = -1
    scene[1][3] = -50
    scene[4][4, 0] = torch.nan
    for antialiased in (False, True):
        grads = gradients(scene, latlong(dtype=torch.float32, device=device), antialiased=antialiased)
        assert all(bool(gradient.isfinite().all()) for gradient in grads)
        assert all(float(grads[3][i]) == 0 for i in (0, 4)) and float(grads[3][1]) != 0


def test_larger_pixels_keep_the_light(device):
    """A faint speck, far smaller than a pixel of either map."""
    mean = torch.tensor([[0.3, 0.4, 2.0]], device=device)
    quaternion, opacity = torch.tensor([[1.0, 0, 0, 0]], device=device), torch.tensor([0.9], device=device)
    scene = mean, torch.full((1, 3), -4.5, device=device), quaternion, opacity, torch.ones(1, 1, device=device)
    light = []
    for size in (256, 1024):
        directions = latlong(size, torch.float32, device)
        options = {"focal_length": 600.0, "pixel_angle": 2 * np.pi / size, "alpha_threshold": 1e-5}
        image, _ = rasterize_directions(*scene, torch.zeros(3, device=device), directions, **options)
        weight = (1 - directions[..., 1] ** 2).sqrt()
        light.append(float((image[..., 0] * weight).sum()) / size**2)
    assert light[0] == pytest.approx(light[1], rel=0.05)


def test_what_cannot_be_drawn_is_left_out(device):
    scene = gaussians(4, dtype=torch.float32, device=device)
    scene[0][0] = 0  # At the point itself.
    scene[0][1, 0] = torch.nan
    scene[4][2, 1] = torch.inf
    scene[3][3] = 0
    image, left = rasterize_directions(
        *scene, torch.zeros(3, device=device), latlong(dtype=torch.float32, device=device), focal_length=FOCAL
    )
    assert float(image.abs().max()) == 0 and float(left.min()) == 1
    nothing = [tensor[:0] for tensor in scene]
    image, left = rasterize_directions(
        *nothing, torch.zeros(3, device=device), latlong(dtype=torch.float32, device=device), focal_length=FOCAL
    )
    assert image.shape == (32, 64, 4) and float(left.min()) == 1
