"""Rotations of quaternions and ellipses at rectangles against SciPy and sums of many points, in float64."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from sehdr_warp.kernels.geometry import geometry
from sehdr_warp.rasterizer import differentiable
from sehdr_warp.rasterizer.warp_launch.launching import launch

from ..rasterizer.scenes import finite_differences, relative_error

SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
BOUNDS = [(torch.float32, 1e-6), (torch.float64, 1e-14)]
KERNELS = {}


def kernels(dtype):
    if dtype not in KERNELS:
        g = geometry(SCALARS[dtype])
        rotation_from_quaternion, meets = g.rotation_from_quaternion, g.ellipse_meets_rectangle
        vec4s, mat33s = wp.array(dtype=g.vec4), wp.array(dtype=g.mat33)

        @wp.kernel(module="unique")
        def rotate(range_start: int, quaternions: vec4s, matrices: mat33s):
            i = range_start + wp.tid()
            matrices[i] = rotation_from_quaternion(quaternions[i])

        @wp.kernel(module="unique", module_options={"enable_backward": False})
        def meet(range_start: int, centers: vec4s, conics: vec4s, boxes: vec4s, results: wp.array(dtype=wp.bool)):
            i = range_start + wp.tid()
            box = boxes[i]
            results[i] = meets(centers[i], conics[i], box[0], box[1], box[2], box[3])

        KERNELS[dtype] = rotate, meet
    return KERNELS[dtype]


@differentiable
def rotations(program, quaternions):
    matrices = program.empty_output((len(quaternions), 3, 3), quaternions.dtype)
    program.launch(kernels(quaternions.dtype)[0], len(quaternions), [quaternions], [matrices])
    return matrices


@pytest.mark.parametrize("length", [1e-18, 1e-12, 1.0, 1e12, 1e18])
@pytest.mark.parametrize(("dtype", "bound"), BOUNDS)
def test_rotations_are_scipys_whatever_the_length(device, dtype, bound, length):
    quaternions = torch.randn(50, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    truth = Rotation.from_quat(quaternions.roll(-1, 1).numpy()).as_matrix()
    weights = torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(values):
        return (rotations(values.to(device)) * weights.to(device, values.dtype)).sum()

    leaf = (length * quaternions).to(dtype).requires_grad_()
    assert relative_error(rotations(leaf.to(device)), torch.from_numpy(truth)) < bound
    loss(leaf).backward()
    assert relative_error(length * leaf.grad.double(), finite_differences(loss, [quaternions], 0, 1e-4)) < max(
        bound, 1e-9
    )


@pytest.mark.parametrize(("dtype", "_"), BOUNDS)
def test_ellipses_meet_the_rectangles_that_their_points_are_in(device, dtype, _):
    rng = np.random.default_rng(0)
    count, cutoff = 400, 9.0
    centers, sizes = rng.uniform(-9, 9, (count, 2)), rng.uniform(0, 12, (count, 2))
    axes = np.exp(rng.uniform(-2, 2, (count, 2, 1)))
    turn = rng.uniform(0, np.pi, count)
    turn = np.stack([np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)], 1).reshape(-1, 2, 2)
    conics = np.linalg.inv(turn @ (axes**2 * turn.swapaxes(1, 2)))
    # The nearest point of the rectangle from the origin, by the form: the least of a fine grid of it.
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 101)] * 2), -1).reshape(-1, 2)
    points = grid * sizes[:, None] - centers[:, None]
    form = np.einsum("npi,nij,npj->np", points, conics, points).min(1)
    sure = np.abs(form / cutoff - 1) > 0.05
    records = np.zeros((3, count, 4))
    records[0, :, :2], records[1, :, 3], records[2, :, 2:] = centers, cutoff, sizes
    records[1, :, :3] = conics.reshape(-1, 4)[:, [0, 1, 3]]
    inputs = torch.tensor(records, dtype=dtype, device=device)
    results = torch.empty(count, dtype=torch.bool, device=device)
    launch(kernels(dtype)[1], count, *inputs, results)
    assert 0.2 < (form < cutoff).mean() < 0.8 and sure.mean() > 0.9
    np.testing.assert_array_equal(results.cpu().numpy()[sure], (form < cutoff)[sure])
