"""Refine a camera's pose by gradients through the rasterizer, with a photo of a known scene.

python examples/pose_refinement.py
"""

import torch

import sehdr_warp as sw


def rotation(vector: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrix of an axis times its angle, [3]."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return torch.linalg.matrix_exp(cross)


def main(steps: int = 120, size: int = 64) -> tuple[float, float]:
    """Return the distance to the true camera before and after, in scene units."""
    generator = torch.Generator().manual_seed(0)
    count = 400
    gaussians = (
        torch.rand(count, 3, generator=generator) * 2.0 - 1.0,  # means
        torch.full((count, 3), -2.5),  # logarithms of the sizes
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.full((count,), 0.8),
        torch.rand(count, 3, generator=generator),  # colors
    )
    intrinsics = torch.tensor([1.2 * size, 1.2 * size, size / 2, size / 2])
    truth = torch.eye(4)
    truth[2, 3] = 4.0
    with torch.no_grad():
        photo = sw.rasterize(*gaussians, truth, intrinsics, size, size).image

    turn = torch.tensor([0.03, -0.04, 0.05], requires_grad=True)
    shift = torch.tensor([0.1, -0.08, 0.15], requires_grad=True)
    optimizer = torch.optim.Adam([turn, shift], lr=5e-3)

    def pose() -> torch.Tensor:
        """Return world_to_camera, a small motion before the true pose."""
        motion = torch.cat([torch.cat([rotation(turn), shift[:, None]], dim=1), torch.eye(4)[3:]])
        return motion @ truth

    def distance() -> float:
        """Return how far the camera is from where the photo was taken."""
        centers = [-matrix[:3, :3].T @ matrix[:3, 3] for matrix in (pose().detach(), truth)]
        return float((centers[0] - centers[1]).norm())

    before = distance()
    for _ in range(steps):
        image = sw.rasterize(*gaussians, pose(), intrinsics, size, size).image
        loss = (image - photo).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    print(f"camera {before:.3f} -> {distance():.4f} scene units from where the photo was taken")
    return before, distance()


if __name__ == "__main__":
    main()
