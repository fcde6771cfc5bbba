"""Beside gsplat itself, where it is installed: its torch functions on the CPU, and its kernels on a GPU."""

import math
import tempfile
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from sehdr_warp.compat import gsplat as ours

from .scenes import COUNT, HEIGHT, WIDTH, gradients, scene

gsplat = pytest.importorskip("gsplat")
reference = pytest.importorskip("gsplat.cuda._torch_impl")


@pytest.fixture(scope="module")
def compiled():
    """gsplat's kernels, which two processes cannot compile at one time: each removes what the other has begun."""
    with FileLock(Path(tempfile.gettempdir(), "gsplat-compiles.lock")):
        pytest.importorskip("gsplat.cuda._backend")


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("compensated", [False, True])
def test_projections_are_gsplats(model, compensated):
    leaves, place = scene()
    means, quats, scales = leaves[:3]
    covars, _ = reference._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
    true = reference._fully_fused_projection(means, covars, *place, calc_compensations=compensated, camera_model=model)
    result = ours.fully_fused_projection(
        means, None, quats, scales, *place, calc_compensations=compensated, camera_model=model
    )
    # Radii of gsplat's torch function are round, and ours are 3.33 standard deviations and not 3 wide.
    visible = (result[0] > 0).all(-1) & (true[0] > 0).all(-1)
    assert int(visible.sum()) > COUNT
    for mine, its in zip(result[1:4], true[1:4], strict=True):
        torch.testing.assert_close(mine[visible], its[visible], rtol=1e-4, atol=1e-4)
    if compensated:
        torch.testing.assert_close(result[4][visible], true[4][visible], rtol=1e-3, atol=1e-4)


def test_intersections_are_gsplats():
    leaves, place = scene()
    _, _, info = ours.rasterization(*leaves, **place._asdict(), packed=False)
    inputs = info["means2d"].detach(), info["radii"], info["depths"].detach(), 16, 3, 2
    true = reference._isect_tiles(*inputs)
    result = ours.isect_tiles(*inputs)
    assert (
        torch.equal(result[0], true[0].int()) and torch.equal(result[1], true[1]) and result[2].shape == true[2].shape
    )
    offsets = reference._isect_offset_encode(true[1], 2, 3, 2)
    assert torch.equal(ours.isect_offset_encode(result[1], 2, 3, 2), offsets.int())


def test_harmonics_are_gsplats():
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(2, 50, 3, generator=generator)
    coefficients = torch.randn(2, 50, 25, 3, generator=generator)
    for degree in range(5):
        true = reference._spherical_harmonics(degree, directions, coefficients)
        torch.testing.assert_close(
            ours.spherical_harmonics(degree, directions, coefficients), true, rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize("absgrad", [False, True])
def test_its_own_strategy_takes_what_we_render_and_does_what_ours_does(absgrad):
    counts = []
    for module in (gsplat.strategy, ours):
        torch.manual_seed(0)
        leaves, place = scene()
        values = dict(zip(("means", "quats", "scales", "opacities", "colors"), leaves, strict=True))
        values["scales"], values["opacities"] = (
            values["scales"].log(),
            torch.logit(values["opacities"].clamp(0.001, 0.999)),
        )
        params = torch.nn.ParameterDict({k: torch.nn.Parameter(v.detach().clone()) for k, v in values.items()})
        optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}
        strategy = module.DefaultStrategy(
            refine_start_iter=1, refine_every=3, grow_grad2d=2e-5, grow_scale3d=0.1, reset_every=7, absgrad=absgrad,
            refine_scale2d_stop_iter=20, grow_scale2d=0.2,
        )  # fmt: skip
        strategy.check_sanity(params, optimizers)
        state, numbers = strategy.initialize_state(scene_scale=1.0), []
        for step in range(5):
            inputs = params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid()
            colors, _, info = ours.rasterization(
                *inputs, params["colors"], **place._asdict(), packed=False, absgrad=absgrad
            )
            strategy.step_pre_backward(params, optimizers, state, step, info)
            (colors - 0.5).square().mean().backward()
            strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            numbers.append(len(params["means"]))
        counts.append(numbers)
    assert counts[0] == counts[1] and counts[0][-1] != COUNT


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat renders on a GPU alone")
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    "options", [{}, {"render_mode": "RGB+ED"}, {"sh_degree": 2}, {"rasterize_mode": "antialiased"}]
)
@pytest.mark.usefixtures("compiled")
def test_images_and_gradients_are_gsplats(options, packed):
    leaves, place = scene("cuda:0", coefficients=9 if "sh_degree" in options else 0)
    results = []
    for module in (gsplat, ours):
        colors, alphas, info = module.rasterization(*leaves, **place._asdict(), packed=packed, absgrad=True, **options)
        info["means2d"].retain_grad()
        results.append((colors, alphas, gradients(colors, leaves), info["means2d"].absgrad))
    (colors, alphas, result, absolute), (mine, my_alphas, my_found, my_absolute) = results
    assert colors.shape == (2, HEIGHT, WIDTH, colors.shape[-1])
    torch.testing.assert_close(mine, colors, rtol=1e-2, atol=2e-3)
    torch.testing.assert_close(my_alphas, alphas, rtol=1e-2, atol=2e-3)
    for one, two in zip(my_found, result, strict=True):
        assert float((one - two).norm() / two.norm()) < (0.05 if "rasterize_mode" in options else 0.01)
    if not packed:
        assert float((my_absolute - absolute).norm() / absolute.norm()) < 0.01


def relocation_by_sums(opacities, scales, ratios, binoms):
    """gsplat's kernel for relocation, as its sums are written, in float64."""
    pairs = []
    for opacity, count in zip(opacities.double().tolist(), ratios.tolist(), strict=True):
        shared, total = 1 - (1 - opacity) ** (1 / count), 0.0
        for i in range(1, count + 1):
            for k in range(i):
                total += float(binoms[i - 1, k]) * (-1) ** k / math.sqrt(k + 1) * shared ** (k + 1)
        pairs.append((shared, opacity / total))
    shared, factors = torch.tensor(pairs, dtype=scales.dtype).T
    return shared, scales * factors[:, None]


def test_mcmc_changes_gaussians_and_moments_as_gsplats_does(monkeypatch):
    draws = torch.Generator()

    def draw(weights, count, **_):
        return torch.multinomial(weights, count, replacement=True, generator=draws)

    operations = pytest.importorskip("gsplat.strategy.ops")
    monkeypatch.setattr(operations, "_multinomial_sample", draw)
    monkeypatch.setattr(operations, "compute_relocation", relocation_by_sums)
    monkeypatch.setattr(operations, "quat_scale_to_covar_preci", reference._quat_scale_to_covar_preci)
    monkeypatch.setattr("sehdr_warp.compat.gsplat.strategy.ops._draw", draw)
    results = []
    for module in (gsplat, ours):
        torch.manual_seed(0)
        draws.manual_seed(0)
        values = {
            "means": torch.randn(COUNT, 3), "scales": torch.rand(COUNT, 3) - 3.0, "quats": torch.randn(COUNT, 4),
            "opacities": torch.linspace(-7.0, 3.0, COUNT), "sh0": torch.randn(COUNT, 1, 3),
        }  # fmt: skip
        params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in values.items()})
        optimizers = {name: torch.optim.Adam([params[name]], lr=1e-2) for name in params}
        strategy = module.MCMCStrategy(cap_max=COUNT + 9, refine_start_iter=1, refine_every=3, noise_lr=5.0)
        state = strategy.initialize_state()
        for step in range(8):
            sum((value * value.detach().cos()).sum() for value in params.values()).backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            strategy.step_post_backward(params, optimizers, state, step, {}, lr=1e-2)
        moments = [optimizers[name].state[params[name]]["exp_avg"] for name in params]
        results.append([value.detach() for value in params.values()] + moments)
    assert len(results[0][0]) > COUNT
    for true, result in zip(*results, strict=True):
        torch.testing.assert_close(result, true, rtol=1e-4, atol=1e-5)
