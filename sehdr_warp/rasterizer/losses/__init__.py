"""Losses as torch operations: SSIM, the residual against a photo's codes, and the penalty on opacities."""
