"""Torch operations of Warp kernels beside the render: harmonics, activations, plane sweep, relocation, step updates."""
