"""sehdr-warp: scene-linear HDR Gaussian scenes from photos of one exposure (SeHDR, ICCV 2025)."""
