"""Noise on the positions of faint Gaussians (kernels/exploration.py)."""

import torch
import warp as wp

from ..kernels.exploration import explore
from ..kernels.geometry import vector
from . import threads
from .arrays import view
from .bridge import torch_stream


@torch.no_grad()
def add_exploration_noise(
    means: torch.Tensor,
    log_scales: torch.Tensor,
    quaternions: torch.Tensor,
    opacity_logits: torch.Tensor,
    *,
    strength: float,
    seed: int,
) -> None:
    """Adds to means, in place, the noise of 3DGS-MCMC's equation 8: normal, shaped by each Gaussian's covariance, and
    faded out where opacities are above some hundredths.

    means, log_scales: [N, 3]; quaternions: [N, 4], any length; opacity_logits: [N]; all contiguous float32 on one
    device. strength: times the covariance, in world units the standard deviation; seed: of this call, an int32; the
    same one gives the same noise on every device and with any number of threads.
    """
    count = means.shape[0]
    if not count:
        return
    vec3, vec4 = vector(3, wp.float32), vector(4, wp.float32)
    arguments = [
        view(log_scales.detach(), vec3),
        view(quaternions.detach(), vec4),
        view(opacity_logits.detach()),
        seed,
        strength,
        view(means.detach(), vec3),
    ]
    device = wp.device_from_torch(means.device)
    if device.is_cpu:
        threads.launch_ranges(explore, threads.even_ranges(count), arguments, device)
        return
    with torch_stream(means.device):
        wp.launch(explore, dim=count, inputs=[0, *arguments], device=device, record_tape=False)
