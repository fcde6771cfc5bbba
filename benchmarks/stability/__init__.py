"""Numerical stability: every stiff and extreme case, of splats, light and training, against float64 truth."""
