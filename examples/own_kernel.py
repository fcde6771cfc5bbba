"""A Warp kernel of your own in torch's graph: fog over the Gaussians, its density found from one picture.

The gradient runs back through the rasterizer, then through the kernel, whose adjoint Warp generates.

python examples/own_kernel.py
"""

# pyright: reportInvalidTypeForm=false
import torch
import warp as wp

import sehdr_warp as sw
from sehdr_warp.rasterizer import Program


@wp.kernel
def attenuate_kernel(
    radiance: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=wp.float32),
    density: wp.array(dtype=wp.float32),
    seen: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    seen[i] = wp.exp(-density[0] * distance[i]) * radiance[i]


@sw.differentiable
def attenuate(program: Program, radiance: torch.Tensor, distance: torch.Tensor, density: torch.Tensor):
    """radiance: [N, 3], distance: [N], density: [1] -> [N, 3]."""
    seen = program.write(radiance.shape)
    program.launch(attenuate_kernel, len(radiance), [radiance, distance, density], [seen])
    return seen


def main(steps: int = 120, count: int = 2000, truth: float = 0.35) -> float:
    """The density found."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([4.0, 4.0, 6.0]) + torch.tensor([-2.0, -2.0, 3.0])
    radiance = torch.rand(count, 3, generator=generator) * 10.0
    log_scales, opacities = torch.full((count, 3), -2.5), torch.full((count,), 0.7)
    quaternions = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    pose, intrinsics = torch.eye(4), torch.tensor([60.0, 60.0, 32.0, 32.0])

    def render(density: torch.Tensor) -> torch.Tensor:
        colors = attenuate(radiance, means.norm(dim=1), density)
        return sw.rasterize(means, log_scales, quaternions, opacities, colors, pose, intrinsics, 64, 64).image

    picture = render(torch.tensor([truth]))
    density = torch.tensor([0.05], requires_grad=True)
    optimizer = torch.optim.Adam([density], lr=0.02)
    for _ in range(steps):
        optimizer.zero_grad()
        loss = (render(density) - picture).square().mean()
        loss.backward()
        optimizer.step()
    print(f"density {density.item():.3f}, truth {truth:.3f}")
    return density.item()


if __name__ == "__main__":
    main()
