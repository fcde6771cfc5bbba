"""Evaluation of a trained run: metrics, the protocols that bring two scales together, and held-out evaluation."""
