"""Losses of images as torch operations: SSIM, and the residual against a photo's codes."""
