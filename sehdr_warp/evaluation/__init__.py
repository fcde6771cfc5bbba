"""How good a trained run is: metrics, the protocols that bring two scales together, and held-out evaluation."""
