"""gsplat's rasterization(), made of ours: what it takes and gives, and a training as its examples make one."""

import pytest
import torch

from sehdr_warp.compat.gsplat import rasterization
from sehdr_warp.rasterizer import rasterize, spherical_harmonics

WIDTH, HEIGHT, COUNT = 40, 30, 200


def scene(device="cpu", count=COUNT, coefficients=0):
    """gsplat's arguments: two cameras before a cloud of Gaussians."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.rand(*shape, generator=generator)

    colors = random(count, coefficients, 3) - 0.5 if coefficients else random(count, 3)
    quaternions = torch.randn(count, 4, generator=generator)
    given = [random(count, 3) * 2 - 1, quaternions, 0.05 + 0.1 * random(count, 3), random(count), colors]
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, 2, 3] = torch.tensor([3.0, 4.0])
    lenses = torch.tensor([[40.0, 0, 20], [0, 42.0, 15], [0, 0, 1]]).repeat(2, 1, 1)
    leaves = [tensor.to(device).requires_grad_() for tensor in given]
    return leaves, [poses.to(device), lenses.to(device), WIDTH, HEIGHT]


def alone(leaves, place, camera, features=None, **options):
    means, quaternions, scales, opacities, colors = leaves
    pose, lens = place[0][camera], torch.tensor([40.0, 42.0, 20.0, 15.0], device=means.device)
    features = colors if features is None else features
    return rasterize(means, scales.log(), quaternions, opacities, features, pose, lens, WIDTH, HEIGHT, **options)


def test_cameras_in_one_call_are_those_of_each_alone(device):
    leaves, place = scene(device)
    background = torch.tensor([[0.2, 0.4, 0.8], [1.0, 0.0, 0.5]], device=device)
    colors, alphas, info = rasterization(*leaves, *place, backgrounds=background, render_mode="RGB+ED")
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
    for given, leaf in zip(together, leaves, strict=True):
        torch.testing.assert_close(given, leaf.grad, rtol=1e-3, atol=1e-3)


def test_harmonics_depths_and_the_far_plane(device):
    leaves, place = scene(device, coefficients=9)
    means, coefficients = leaves[0], leaves[4]
    colors, _, info = rasterization(*leaves, *place, sh_degree=2)
    eye = torch.tensor([0.0, 0.0, -4.0], device=device)
    lit = (spherical_harmonics(2, coefficients, means, eye) + 0.5).clamp_min(0)
    torch.testing.assert_close(colors[1], alone(leaves, place, 1, lit).image)
    depths, _, _ = rasterization(*leaves, *place, sh_degree=2, render_mode="D", far_plane=3.0)
    assert depths.shape == (2, HEIGHT, WIDTH, 1)
    near = (means[:, 2] + 3.0 <= 3.0).nonzero()[:, 0]
    kept = [leaf[near] for leaf in leaves]
    torch.testing.assert_close(depths[0, ..., 0], alone(kept, place, 0, lit[near], depth=True).depth)
    assert info["n_cameras"] == 2 and info["width"] == WIDTH and info["means2d"].shape == (2, COUNT, 2)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"absgrad": True}, "absgrad = True is not supported, expected False"),
        ({"camera_model": "fisheye"}, "camera_model = 'fisheye' is not supported"),
        ({"render_mode": "rgb"}, "render_mode 'rgb' is none of RGB"),
        ({"far": 3}, "no argument 'far'"),
    ],
)
def test_what_is_not_supported_is_said(options, said):
    leaves, place = scene()
    with pytest.raises((ValueError, TypeError), match=said):
        rasterization(*leaves, *place, **options)


def test_a_training_as_gsplats_examples_make_one(device):
    """With gsplat installed its own strategy adds and removes Gaussians by what rasterization() returns."""
    truth, place = scene(device)
    photos = rasterization(*truth, *place)[0].detach()
    means, quaternions, _, _, _ = (leaf.detach() for leaf in truth)
    parameters = {
        "means": means + 0.05 * torch.randn(means.shape, generator=torch.Generator().manual_seed(1)).to(device),
        "quats": quaternions.clone(),
        "scales": torch.full_like(means, -2.5),
        "opacities": torch.zeros(COUNT, device=device),
        "colors": torch.full_like(means, 0.5),
    }
    splats = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in parameters.items()})
    optimizers = {name: torch.optim.Adam([{"params": p, "lr": 0.01, "name": name}]) for name, p in splats.items()}
    strategies = pytest.importorskip("gsplat.strategy") if _has_gsplat() else None
    strategy = strategies and strategies.DefaultStrategy(refine_start_iter=10, refine_every=10, reset_every=1000)
    state = strategy and strategy.initialize_state(scene_scale=1.0)
    losses = []
    for step in range(60):
        scales, opacities = splats["scales"].exp(), splats["opacities"].sigmoid()
        given = splats["means"], splats["quats"], scales, opacities, splats["colors"]
        colors, _, info = rasterization(*given, *place, packed=False, absgrad=False, sparse_grad=False)
        if strategy:
            strategy.step_pre_backward(splats, optimizers, state, step, info)
        loss = (colors - photos).abs().mean()
        loss.backward()
        if strategy:
            strategy.step_post_backward(splats, optimizers, state, step, info, packed=False)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.5 * losses[0]
    assert not strategy or len(splats["means"]) != COUNT


def _has_gsplat() -> bool:
    try:
        import gsplat.strategy  # noqa: F401
    except ImportError:
        return False
    return True
