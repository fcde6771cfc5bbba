"""Torch operations of Warp kernels beside the render: harmonics, plane sweep, relocation, step updates."""
