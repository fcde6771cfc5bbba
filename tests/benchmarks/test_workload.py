"""Work of the block kernels is counted as they do it."""

import torch
import warp as wp

from benchmarks.splats import Size, make_splat_scene
from benchmarks.workload import count_blended_pairs
from sehdr_warp.kernels.constants import ALPHA_THRESHOLD
from sehdr_warp.rasterizer import rasterize


def test_pairs_are_counted_as_the_block_kernels_blend_them(device, monkeypatch):
    scene = make_splat_scene(Size(400, 40, 24), 3, device)
    means, log_scales, quaternions, opacities, features = scene.leaves
    pose, lens = scene.world_to_camera, scene.intrinsics

    def counted(opacities, grown=0.0):
        """Return the counts, and the warps that have a pixel which a Gaussian would color if it were alone."""
        gaussians = means, log_scales + grown, quaternions, opacities, features
        with monkeypatch.context() as blocks:
            blocks.setattr(wp.config, "enable_cpu_blocks", device == "cpu")
            pairs, blended = count_blended_pairs((*gaussians, pose, lens), 40, 24)
        each = [rasterize(*(tensor[i : i + 1] for tensor in gaussians), pose, lens, 40, 24).alpha for i in range(400)]
        colored = torch.stack(each) >= ALPHA_THRESHOLD
        assert pairs == rasterize(*gaussians, pose, lens, 40, 24).intersection_count
        return blended, int(colored.view(400, 6, 4, 5, 8).any(4).any(2).sum())

    faint, alone = counted(0.05 * opacities)
    assert alone <= faint < 1.1 * alone
    opaque, alone = counted(torch.full_like(opacities, 0.9999), grown=1.5)
    assert opaque < alone / 3  # The others are behind the last that a pixel of the warp shows.
