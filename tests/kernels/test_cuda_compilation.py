"""Compile kernels for CUDA, without a GPU: machines of continuous integration have none.

Warp comes with NVIDIA's compiler. What the kernels compute is tested by the files beside this one, on a GPU if there is
one.
"""

from collections.abc import Callable
from typing import Any

import pytest
import warp as wp

from sehdr_warp.kernels import (
    absolute_gradient,
    blend_cuda,
    blend_cuda_backward,
    caller_memory,
    clipped_light,
    code_residual,
    exposure_fusion,
    harmonics,
    interpolation,
    opacity_penalty,
    plane_sweep,
    project,
    relocation,
    residual_sampling,
    response_curves,
    sphere,
    ssim_cuda,
    step_updates,
    tiles,
)

ARCHITECTURES = wp.get_cuda_supported_archs()
REAL = wp.float32
KERNELS: dict[str, Callable[[], Any]] = {
    "absolute gradient": lambda: absolute_gradient.absolute_gradient_kernel(REAL),
    "blend, 3 channels": lambda: blend_cuda.forward_kernel(REAL, 3, True),
    "blend, 9 channels": lambda: blend_cuda.forward_kernel(REAL, 9, True),
    "blend backward, 3 channels": lambda: blend_cuda_backward.backward_kernel(REAL, 3, False, True),
    "blend backward, 3 channels, deterministic": lambda: blend_cuda_backward.backward_kernel(REAL, 3, True, True),
    "blend backward, 9 channels": lambda: blend_cuda_backward.backward_kernel(REAL, 9, False, True),
    "copy features": lambda: blend_cuda_backward.copy_features_kernel(REAL),
    "caller memory": lambda: caller_memory,
    "clipped light": lambda: clipped_light.clipped_light_patch_kernel(REAL, wp.uint8),
    "clipped logarithms": lambda: clipped_light.clipped_logarithms_kernel(REAL, wp.uint16),
    "code residual": lambda: code_residual.code_residual_kernel(REAL, wp.uint8, True),
    "encode": lambda: response_curves.encode_kernel(REAL, 0),
    "fusion": lambda: exposure_fusion.fusion_kernels(REAL),
    "harmonics": lambda: harmonics.harmonics_kernel(REAL, 3),
    "harmonics backward": lambda: harmonics.harmonics_backward_kernel(REAL, 3, True),
    "harmonics, Adam": lambda: step_updates.harmonics_adam_kernel(4),
    "interpolation": lambda: interpolation,
    "opacity penalty": lambda: opacity_penalty.opacity_penalty_kernel(REAL),
    "opacity penalty, backward": lambda: opacity_penalty.opacity_penalty_backward_kernel(REAL),
    "plane sweep": lambda: plane_sweep,
    "projection": lambda: project.projection_kernel(REAL, False, False, False),
    "projection, antialiased": lambda: project.projection_kernel(REAL, True, False, False),
    "projection, antialiased as in gsplat": lambda: project.projection_kernel(REAL, True, True, False),
    "projection, own cameras": lambda: project.projection_kernel(REAL, False, False, True),
    "projection, own cameras, antialiased": lambda: project.projection_kernel(REAL, True, False, True),
    "projection, own cameras, antialiased as in gsplat": lambda: project.projection_kernel(REAL, True, True, True),
    "projection, sphere": lambda: sphere.projection_kernel(REAL, False, False),
    "projection, sphere, own positions": lambda: sphere.projection_kernel(REAL, False, True),
    "projection, sphere, own positions, antialiased": lambda: sphere.projection_kernel(REAL, True, True),
    "relocation": lambda: relocation,
    "sampled errors": lambda: residual_sampling.error_weights_kernel(wp.uint8),
    "sphere": lambda: sphere.sphere_kernels(REAL, 3),
    "SSIM": lambda: ssim_cuda.ssim_patch_kernels(REAL, True),
    "tile lists": lambda: tiles.tile_ranges_kernel(REAL, wp.int64, 32),
    "tiles": lambda: tiles.tile_kernels(REAL),
    "tiles, module": lambda: tiles,
    "training step": lambda: step_updates,
}


def warp_modules(kernel_objects: Any) -> list[Any]:
    """Return the modules of a kernel, of a namespace of kernels or of a Python module."""
    kernels = (
        [kernel_objects]
        if isinstance(kernel_objects, wp.Kernel)
        else [k for k in vars(kernel_objects).values() if isinstance(k, wp.Kernel)]
    )
    assert kernels
    return list({id(kernel.module): kernel.module for kernel in kernels}.values())


@pytest.mark.skipif(not ARCHITECTURES, reason="this build of Warp has no compiler for CUDA")
@pytest.mark.parametrize("name", KERNELS)
def test_kernels_compile_for_cuda(tmp_path, name, monkeypatch):
    monkeypatch.setattr(wp.config, "optimization_level", 0)  # Whether they compile does not depend on it.
    for number, module in enumerate(warp_modules(KERNELS[name]())):
        folder = tmp_path / str(number)
        [path] = wp.compile_aot_module(module, arch=min(ARCHITECTURES), module_dir=folder, use_ptx=True)
        assert ".entry" in path.read_text()
        module.mark_modified()  # Its hash, which names its compiled code, had this level.
