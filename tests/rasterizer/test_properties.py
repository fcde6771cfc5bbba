"""Public operations under any numbers (hypothesis): a right result, a documented culling, or an error by name."""

import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sehdr_warp.rasterizer import rasterize
from sehdr_warp.rasterizer.reference import rasterize_reference

SETTINGS = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
anything = st.floats(width=32, allow_nan=True, allow_infinity=True, allow_subnormal=True)
modest = st.floats(-4, 4, width=32)
COUNT = 5


def tensor(rows):
    return torch.tensor(rows, dtype=torch.float32)


def rows(element, columns, count=COUNT):
    return st.lists(st.lists(element, min_size=columns, max_size=columns), min_size=count, max_size=count).map(tensor)


def camera():
    pose = torch.eye(4)
    pose[2, 3] = 4.0
    return pose, torch.tensor([20.0, 20.0, 9.0, 7.0])


@SETTINGS
@given(rows(modest, 3), rows(modest, 3), rows(modest, 4), rows(st.floats(0, 1, width=32), 1), rows(modest, 3))
def test_any_modest_gaussians_match_the_reference(means, log_scales, quaternions, opacities, features):
    # A contribution at the threshold counts on one side and not on the other, and so does a whole Gaussian of that
    # opacity; a low threshold makes them worth little. The same holds where a pixel is finished.
    means[:, 2].clamp_(min=-3.5)
    # Depths that float32 cannot tell apart may be drawn in either order: only equal ones have theirs by index.
    means[:, 2] = (means[:, 2] * 1024).round() / 1024
    quaternions[quaternions.norm(dim=1) < 1e-6] = 0.0
    tensors = [means, log_scales.clamp_max(1.0), quaternions, opacities[:, 0], features, *camera()]
    ours = rasterize(*tensors, 18, 14, alpha_threshold=1e-5)
    truth = rasterize_reference(*(t.double() for t in tensors), 18, 14, alpha_threshold=1e-5)
    largest = float(features.abs().max())
    assert float((ours.image - truth.image).abs().max()) <= (1e-4 + (COUNT + 1) * 1e-4) * largest
    assert float(ours.alpha.min()) >= 0 and float(ours.alpha.max()) <= 1


@SETTINGS
@given(st.data())
def test_one_gaussian_of_any_numbers_leaves_the_others_alone(data):
    generator = torch.Generator().manual_seed(0)
    good = [torch.randn(COUNT, n, generator=generator) * 0.5 for n in (3, 3, 4, 1, 3)]
    good[1] -= 2.0
    good[3] = torch.full((COUNT, 1), 0.5)
    for part in good:
        part[2] = tensor([data.draw(anything) for _ in range(part.shape[1])])
    good[3] = torch.where(good[3].isfinite(), good[3].clamp(0, 1), good[3])
    leaves = [part.clone().requires_grad_() for part in good]
    inputs = [leaves[0], leaves[1], leaves[2], leaves[3][:, 0], leaves[4]]
    arguments = [*inputs, *camera(), 18, 14]
    rendering = rasterize(*arguments)
    others = torch.arange(COUNT) != 2
    if not bool(rendering.visible[2]):
        arguments[:5] = (part[others] for part in inputs)
        without = rasterize(*arguments)
        assert torch.equal(rendering.image, without.image)
        rendering.image.sum().backward()
        assert all(bool(leaf.grad[others].isfinite().all()) for leaf in leaves)
    elif float(good[4][2].abs().max()) < 1e30:
        assert bool(rendering.image.isfinite().all())
