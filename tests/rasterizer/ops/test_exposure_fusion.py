"""Fusion as an operation; what its kernels compute is compared in tests/kernels."""

import torch

from sehdr_warp.rasterizer.ops.exposure_fusion import fuse_exposures

from ...kernels.test_exposure_fusion import brackets, learned, parts
from ..scenes import relative_error


def test_fused_light_on_the_cpu_does_not_depend_on_torchs_threads():
    generator = torch.Generator().manual_seed(0)
    ours = [torch.randn(part.shape, generator=generator) for part in parts(learned(torch.float32, width=128))]
    before, values = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 4, 8):
            torch.set_num_threads(threads)
            values.append([fuse_exposures(brackets(count).float(), *ours, scale=2.5) for count in (200, 1026)])
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    for others in values[1:]:
        assert all(map(torch.equal, others, values[0]))


def test_brackets_that_are_learned_have_gradients_too(device):
    encoded, ours = brackets().to(device), parts(learned(torch.float64, device))
    plain = fuse_exposures(encoded, *ours, scale=1.5)
    leaf = encoded.clone().requires_grad_()
    through = fuse_exposures(leaf, *ours, scale=1.5)
    through.sum().backward()
    assert relative_error(through, plain) < 1e-12 and bool((leaf.grad != 0).any())
