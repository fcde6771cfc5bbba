"""The rasterizer in a training loop of your own: any channels, here color and depth in one pass.

python examples/own_loop.py
"""

import torch
from scipy.spatial import KDTree

import sehdr_warp as sw


def main(steps: int = 90, max_size: int = 64) -> list[float]:
    """Fits colored Gaussians to the embedded scene's photos; the loss of each step."""
    scene = sw.load_scene("embedded", max_size=max_size)
    points, colors = sw.match_points(scene, 3000)  # or scene.points, where the set has some
    means = torch.tensor(points, dtype=torch.float32)
    distances, _ = KDTree(points).query(points, k=4)  # of each point to itself and its three nearest
    spacing = torch.tensor(distances[:, 1:].mean(axis=1, keepdims=True), dtype=torch.float32)
    parameters = {
        "means": means,
        "log_scales": spacing.log().expand(-1, 3).clone(),
        "quaternions": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1),  # (w, x, y, z)
        "opacity_logits": torch.zeros(len(means)),
        "colors": torch.tensor(colors),
    }
    rates = {"means": 1e-3, "log_scales": 1e-2, "quaternions": 1e-3, "opacity_logits": 5e-2, "colors": 1e-2}
    optimizer = torch.optim.Adam([{"params": [p.requires_grad_()], "lr": rates[n]} for n, p in parameters.items()])

    def render(camera: sw.Camera) -> sw.Rendering:
        """A rendering of four channels: color, and depth along the camera's axis, both over black."""
        pose = torch.tensor(camera.world_to_camera, dtype=torch.float32)
        depth = parameters["means"] @ pose[2, :3] + pose[2, 3]
        return sw.rasterize(
            parameters["means"],
            parameters["log_scales"],
            parameters["quaternions"],
            parameters["opacity_logits"].sigmoid(),
            torch.cat([parameters["colors"], depth[:, None]], dim=1),
            pose,
            torch.tensor(camera.intrinsics, dtype=torch.float32),
            camera.width,
            camera.height,
        )

    losses: list[float] = []
    for step in range(steps):
        view = scene.train_views[step % len(scene.train_views)]
        rendering, photo = render(view.camera), torch.tensor(view.image)
        image = rendering.image[..., :3]
        loss = (image - photo).abs().mean() + 0.2 * (1.0 - sw.ssim(image, photo))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())

    rendering = render(scene.test_views[0].camera)
    seen = rendering.alpha > 0.9
    depth = (rendering.image[..., 3] / rendering.alpha)[seen].median()
    print(f"loss {losses[0]:.3f} -> {losses[-1]:.3f}; median depth of a held-out view {depth.item():.2f} m")
    return losses


if __name__ == "__main__":
    main()
