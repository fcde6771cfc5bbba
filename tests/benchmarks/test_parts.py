"""Parts of a training step are recognized by their kernels, and compared with their lower bounds."""

import pytest
import torch

from benchmarks import parts
from benchmarks.splats import Size
from benchmarks.step import bench_step


@pytest.mark.parametrize(
    "kernel, part",
    [
        ("project_d287a562_cuda_kernel_forward", "projection"),
        ("project_d287a562_cuda_kernel_backward", "projection, backward"),
        ("backward_kernel__locals__blend_backward_64b9232b_cuda_kernel_forward", "blend, backward"),
        ("tile_kernels__locals__pack_splats_64b9232b_cuda_kernel_forward", "lists"),
        ("tile_ranges_kernel__locals__find_tile_ranges_64b9232b_cuda_kernel_forward", "lists"),
        ("jacobian_backward_kernel__locals__jacobian_backward_64b9232b_cuda_kernel_forward", "harmonics"),
        ("void cub::_V_3::detail::radix_sort::DeviceRadixSortOnesweepKernel<int>", "lists"),
        ("opacity_penalty_kernel__locals__sum_opacities_3c9e86f4_cuda_kernel_forward", "losses"),
        ("update_harmonics_by_adam_973af1cd_cuda_kernel_forward", "optimizer"),
        ("void at::native::vectorized_elementwise_kernel<4, at::native::exp_kernel_cuda>", parts.OTHER),
    ],
)
def test_each_kernel_has_a_part(kernel, part):
    assert parts.part_of(kernel) == part


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_parts_of_a_step_are_measured_on_a_gpu():
    result = bench_step(Size(2000, 64, 48), torch.device("cuda:0"), presets=["default"], repetitions=3, views=4)
    rows = {row["part"]: row for row in result["parts"]}
    assert rows.keys() == parts.KERNELS.keys() - {"response and fusion"}
    assert all(row["microseconds"] > 0 and row["launches"] >= 1 for row in rows.values())
    assert rows["optimizer"]["launches"] < rows[parts.OTHER]["launches"]
    assert rows["blend"]["over_bound"] > 0.5
